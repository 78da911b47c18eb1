"""Plain JSON, YAML, and archives: read foreign text safely, and write YAML that reads back equal.

Each function that reads JSON or YAML text returns the value, or raises ``Unreadable`` with the reason.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar
from zipfile import ZipFile

import yaml

from wheelleg_exp.errors import RunDirectoryError

if TYPE_CHECKING:
    _Loader = yaml.SafeLoader
else:
    _Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_T = TypeVar("_T")
# YAML can have at most 200 nested levels, because much deeper nesting crashes the C parser.
_DEEPEST = 200
_MOST_NODES = 1_000_000  # after expanding aliases
# A zip archive's unpacked size is at most _TIMES times its packed size plus _PACKED_ROOM bytes.
_TIMES, _PACKED_ROOM = 16, 1 << 20
_MOST_BITS = 1023  # An integer of at most 1023 bits can be converted to a float.
_OPENING = (b"[", b"{", b"-", b":", b"?")  # Each nesting level of a YAML text needs one of these characters.


class Unreadable(ValueError):
    """A text is not valid JSON or YAML, or contains a value that ``wheelleg`` never writes. Lines count from 1."""

    def __init__(self, problem: str, line: int | None = None) -> None:
        super().__init__(problem)
        self.problem, self.line = problem, line


def json_value(data: bytes | str) -> Any:
    """Return the value of a JSON text; raise Unreadable if a key is repeated."""
    try:
        return _bounded(json.loads(data, object_pairs_hook=_without_repeats, parse_constant=_no_number))
    except json.JSONDecodeError as error:
        raise Unreadable(error.msg, error.lineno) from error
    except UnicodeDecodeError as error:
        raise Unreadable("the JSON data is not UTF-8 text") from error
    except RecursionError as error:
        raise Unreadable("the JSON text is nested too deeply") from error
    except Unreadable:
        raise
    except (ValueError, MemoryError) as error:
        raise Unreadable(str(error) or "the JSON text is too large") from error


def yaml_value(data: bytes | str) -> Any:
    """Return the value of a YAML text as plain Python; raise Unreadable for anchors and repeated keys."""
    return _read(data, lambda: _bounded(yaml.load(data, Loader=_PlainLoader)), aliases=False)


def tagged_yaml_value(data: bytes | str) -> Any:
    """Return the value of a YAML text with Python's tags, such as Isaac Lab's ``env.yaml``, as plain Python.

    No tag is followed: a tuple becomes a list, a whole slice null, a name its text, and any other object its content.
    """
    return _read(data, lambda: _bounded(yaml.load(data, Loader=_TaggedLoader)), aliases=True)


def yaml_tree(data: bytes | str) -> yaml.Node | None:
    """Return the nodes of a YAML text, each with its line number, as a tree."""
    return _read(data, lambda: yaml.compose(data, Loader=_Loader), aliases=True)


def require_bounded(archive: ZipFile) -> None:
    """Raise Unreadable for a zip bomb, an archive whose unpacked size is far larger than its packed size."""
    parts = archive.infolist()
    if sum(part.file_size for part in parts) > _TIMES * sum(part.compress_size for part in parts) + _PACKED_ROOM:
        raise Unreadable("the archive's unpacked size is too large for its file size")
    if len({part.header_offset for part in parts}) < len(parts):
        raise Unreadable("the archive contains two files that overlap")


class _PlainLoader(_Loader):
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        seen: set[object] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise Unreadable(f"the YAML key '{key.value}' is repeated", key.start_mark.line + 1)
            seen.add(key.value if isinstance(key, yaml.ScalarNode) else id(key))
        return super().construct_mapping(node, deep=deep)


class _TaggedLoader(_PlainLoader):
    pass


def _untagged(loader: _TaggedLoader, suffix: str, node: yaml.Node) -> object:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        content = loader.construct_sequence(node, deep=True)
        return None if suffix.endswith("slice") and not any(content) else content
    assert isinstance(node, yaml.ScalarNode)
    return suffix.split(":", 1)[1] if suffix.startswith("python/name:") else loader.construct_scalar(node)


_TaggedLoader.add_multi_constructor("tag:yaml.org,2002:", _untagged)
_TaggedLoader.add_multi_constructor("!", _untagged)


def _read(data: bytes | str, read: Callable[[], _T], *, aliases: bool) -> _T:
    try:
        # Refuse a YAML text with deep nesting, with forbidden aliases, or with aliases that expand to too many nodes.
        raw = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
        if sum(map(raw.count, _OPENING)) >= _DEEPEST or b"&" in raw:
            sizes: dict[str | None, int] = {}
            above: list[tuple[str | None, int]] = []
            total = 0
            for event in yaml.parse(data, Loader=_Loader):
                line = None if event.start_mark is None else event.start_mark.line + 1
                if isinstance(event, yaml.AliasEvent) and not aliases:
                    raise Unreadable("the YAML text contains references to anchors", line)
                total += sizes.get(event.anchor, 1) if isinstance(event, yaml.AliasEvent) else 1
                if isinstance(event, yaml.CollectionStartEvent):
                    above.append((event.anchor, total))
                elif isinstance(event, yaml.CollectionEndEvent):
                    anchor, before = above.pop()
                    sizes[anchor] = total - before + 1
                if len(above) > _DEEPEST:
                    raise Unreadable("the YAML text is nested too deeply", line)
                if total > _MOST_NODES and sizes:
                    raise Unreadable("the anchors of the YAML text expand to too many nodes", line)
        return read()
    except Unreadable:
        raise
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise Unreadable(problem, mark.line + 1 if mark else None) from error
    except Exception as error:
        raise Unreadable(f"a value of the YAML text cannot be read ({type(error).__name__}: {error})") from error


def _bounded(value: _T) -> _T:
    """Return ``value``; raise Unreadable if ``value`` is nested too deeply or has an integer beyond float's range."""
    waiting: list[tuple[object, int]] = [(value, 0)]
    while waiting:
        node, depth = waiting.pop()
        if isinstance(node, (dict, list)):
            if depth >= _DEEPEST:
                raise Unreadable("the JSON or YAML text is nested too deeply")
            waiting += [(item, depth + 1) for item in (node.values() if isinstance(node, dict) else node)]
        elif isinstance(node, int) and node.bit_length() > _MOST_BITS:
            raise Unreadable(f"an integer of {node.bit_length()} bits in the JSON or YAML text is too large")
    return value


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        repeated = next(name for index, name in enumerate(names) if name in names[:index])
        raise Unreadable(f"the JSON key '{repeated}' is repeated")
    return found


def _no_number(name: str) -> NoReturn:
    raise Unreadable(f"{name} is not a valid number in JSON")


_SCALARS = (str, int, float, bool, type(None))

# YAML 1.2 readers and OmegaConf read a word such as ``1e3`` as a number, but PyYAML reads the word as text.
_NUMBER_ELSEWHERE = re.compile(r"[-+]?(\d[\d_]*\.?\d*|\.\d+)([eE][-+]?\d+)?|0o[0-7]+|[-+]?(inf|nan)", re.IGNORECASE)

# PyYAML writes rare line ends such as U+2028 unchanged in single quotes, but reads line ends as spaces.
_ODD_LINE_END = re.compile("[\r\x85\u2028\u2029\ufeff]")


class _PlainDumper(yaml.SafeDumper):
    def ignore_aliases(self, _: object) -> bool:
        return True  # Write a value that occurs twice as two copies, so that the YAML text contains no anchors.


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "'" if _NUMBER_ELSEWHERE.fullmatch(text) else None
    style = '"' if _ODD_LINE_END.search(text) else style
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_PlainDumper.add_representer(str, _represent_text)


def dump_yaml(value: object) -> str:
    """Return ``value`` as YAML text from which ``yaml.safe_load`` restores an equal value.

    Mappings with text or integer keys, lists, text, numbers, booleans and None are allowed. Any other value raises
    RunDirectoryError, even a numpy scalar, an enumeration, or a subclass, which YAML would not preserve.
    """
    require_plain(value)
    text: str = yaml.dump(
        value, Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=2**16, default_flow_style=False
    )
    return text


def require_plain(value: object, path: str = "") -> None:
    """Raise RunDirectoryError, with the key of the wrong element, if ``dump_yaml`` cannot write ``value``."""
    if type(value) is dict:
        for key, item in value.items():
            if type(key) not in (str, int):
                raise RunDirectoryError(f"the key {key!r} is neither text nor an integer", key=path or None)
            require_plain(item, f"{path}.{key}" if path else str(key))
    elif type(value) is list:
        for index, item in enumerate(value):
            require_plain(item, f"{path}[{index}]")
    elif type(value) not in _SCALARS:
        message = f"a {type(value).__name__} cannot be saved as plain YAML"
        raise RunDirectoryError(message, key=path or None, expected="a mapping, list, text, number, boolean or null")
