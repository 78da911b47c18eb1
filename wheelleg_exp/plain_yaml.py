"""Plain YAML that reads back equal: floats to the last bit, text as text, key order kept."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import yaml

from wheelleg_exp.errors import RunDirectoryError

_SCALARS = (str, int, float, bool, type(None))

# Text that PyYAML reads as text, but YAML 1.2 readers and OmegaConf read as a number.
_NUMBER_ELSEWHERE = re.compile(r"[-+]?(\d[\d_]*\.?\d*|\.\d+)([eE][-+]?\d+)?|0o[0-7]+|[-+]?(inf|nan)", re.IGNORECASE)

# Line ends that PyYAML writes as they are between single quotes, and reads back as a space.
_ODD_LINE_END = re.compile("[\r\x85\u2028\u2029\ufeff]")


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, _: Any) -> bool:
        # A value that is used twice is written twice: no anchors for people to resolve.
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "'" if _NUMBER_ELSEWHERE.fullmatch(text) else None
    style = '"' if _ODD_LINE_END.search(text) else style
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_PlainDumper.add_representer(str, _represent_text)


def dump_yaml(value: Any) -> str:
    """Return ``value`` as YAML text that ``yaml.safe_load`` reads back equal.

    Raises:
        RunDirectoryError: the value holds something else than mappings with text or integer keys, lists,
            text, numbers, booleans and None. Subclasses (numpy scalars, enumerations, config nodes) do not
            count as these, because they would not come back as what they were.
    """
    require_plain(value)
    return yaml.dump(
        value, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=2**16, default_flow_style=False
    )


def require_plain(value: Any, path: str = "") -> None:
    """Raise RunDirectoryError, with the key, unless ``value`` is plain (see ``dump_yaml``)."""
    if type(value) is dict:
        _require_plain_mapping(value, path)
    elif type(value) is list:
        for index, item in enumerate(value):
            require_plain(item, f"{path}[{index}]")
    elif type(value) not in _SCALARS:
        raise RunDirectoryError(
            f"a {type(value).__name__} cannot be kept as plain YAML",
            key=path or None,
            expected="a mapping, list, text, number, boolean or null",
        )


def _require_plain_mapping(value: Mapping[Any, Any], path: str) -> None:
    for key, item in value.items():
        if type(key) not in (str, int):
            raise RunDirectoryError(f"the key {key!r} is neither text nor an integer", key=path or None)
        require_plain(item, f"{path}.{key}" if path else str(key))
