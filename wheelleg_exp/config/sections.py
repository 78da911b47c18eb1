"""Holding one section of the tree against the fields of the dataclass that reads it."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.values import describe, fits
from wheelleg_exp.errors import ConfigError, nearest_name

NOTHING_READS = "nothing reads"
_MISSING = "this value is missing"


def is_missing(error: ConfigError) -> bool:
    """Return whether an error says that a value is missing."""
    return error.message == _MISSING


def check_section(path: str, node: Mapping[str, Any], options: type) -> list[ConfigError]:
    """Hold the keys and values of one section against the fields of a dataclass."""
    keys = schema.keys_of(options)
    errors = []
    for name, value in node.items():
        key = f"{path}.{name}" if path else str(name)
        if name in keys:
            errors += _check_value(key, value, keys[name])
        else:
            errors.append(
                ConfigError(
                    f"{NOTHING_READS} this key",
                    key=key,
                    expected="one of " + ", ".join(keys),
                    nearest=nearest_name(str(name), keys),
                )
            )
    for absent in keys.values():
        if absent.required and absent.name not in node:
            full = f"{path}.{absent.name}" if path else absent.name
            errors.append(ConfigError(_MISSING, key=full, expected=describe(absent.annotation)))
    return errors


def _check_value(path: str, value: Any, key: schema.Key) -> list[ConfigError]:
    if not fits(value, key.annotation):
        return [wrong_type(path, value, key.annotation)]
    nested = _dataclass_in(key.annotation)
    if nested is not None and isinstance(value, Mapping):
        return check_section(path, value, nested)
    wanted = _limits_broken(value, key.limits)
    return [ConfigError(f"{value!r} is out of range", key=path, expected=wanted)] if wanted else []


def wrong_type(path: str, value: Any, annotation: Any) -> ConfigError:
    """Return the error for a value that does not fit its annotation."""
    return ConfigError(f"{value!r} is not of the right type", key=path, expected=describe(annotation))


def _dataclass_in(annotation: Any) -> type | None:
    for option in (annotation, *typing.get_args(annotation)):
        if isinstance(option, type) and dataclasses.is_dataclass(option):
            return option
    return None


def _limits_broken(value: Any, limits: Mapping[str, Any]) -> str | None:
    if isinstance(value, (list, tuple)) and ("length" in limits or "nonzero" in limits):
        numbers = all(isinstance(v, (int, float)) and math.isfinite(v) for v in value)
        if len(value) != limits.get("length", len(value)) or not numbers:
            return f"{limits['length']:g} finite numbers" if "length" in limits else "finite numbers"
        return "numbers that are not all zero" if "nonzero" in limits and not any(value) else None
    if isinstance(value, str) and "pattern" in limits and not re.fullmatch(str(limits["pattern"]), value):
        return str(limits["words"])
    if not isinstance(value, (int, float)):
        return None
    if not math.isfinite(value):
        return "a finite number"
    if "minimum" in limits and not value >= limits["minimum"]:
        return f"at least {limits['minimum']}"
    if "above" in limits and not value > limits["above"]:
        return f"more than {limits['above']}"
    if "maximum" in limits and not value <= limits["maximum"]:
        return f"at most {limits['maximum']}"
    return None
