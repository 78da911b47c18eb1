"""Matching names against regular expressions, with the rules of Isaac Lab's string utilities."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from wheelleg_exp.errors import ConfigError, nearest_name


def match_names(
    expressions: str | Sequence[str],
    names: Sequence[str],
    *,
    key: str,
    what: str,
    preserve_order: bool = False,
) -> tuple[list[int], list[str]]:
    """Return the indices and names that whole-match the expressions.

    Args:
        expressions: one regular expression or several.
        names: the names to match, in the asset's order.
        key: config key of the expressions, for the message.
        what: what the names are (``joint``, ``body``), for the message.
        preserve_order: order by expression (True) or by the asset (False).

    Raises:
        ConfigError: an expression matches nothing, or a name is matched by two expressions.
    """
    patterns = [expressions] if isinstance(expressions, str) else list(expressions)
    owner: dict[str, str] = {}
    ordered: list[str] = []
    for pattern in patterns:
        matched = [name for name in names if _compiled(pattern, key).fullmatch(name)]
        if not matched:
            raise ConfigError(
                f"the {what} expression '{pattern}' matches nothing",
                key=key,
                expected=f"an expression that matches some of: {', '.join(names)}",
                nearest=nearest_name(pattern, names),
            )
        for name in matched:
            if name in owner:
                raise ConfigError(
                    f"{what} '{name}' is matched by both '{owner[name]}' and '{pattern}'",
                    key=key,
                    expected="expressions that do not overlap",
                )
            owner[name] = pattern
        ordered += matched
    chosen = ordered if preserve_order else [name for name in names if name in owner]
    return [names.index(name) for name in chosen], chosen


def values_by_name(
    values: float | int | Mapping[str, Any], names: Sequence[str], default: Any, *, key: str, what: str
) -> list[Any]:
    """Spread a number, or a mapping of expressions to values, over names.

    Returns:
        One value a name; names that no expression matches keep ``default``.

    Raises:
        ConfigError: an expression matches nothing, or two match one name.
    """
    if not isinstance(values, Mapping):
        return [values] * len(names)
    spread = [default] * len(names)
    match_names(list(values), names, key=key, what=what)
    for pattern, value in values.items():
        for index in match_names(pattern, names, key=key, what=what)[0]:
            spread[index] = value
    return spread


def require_numbers(values: Sequence[float], count: int, key: str) -> None:
    """Raise ConfigError unless there are ``count`` numbers."""
    if len(values) != count:
        raise ConfigError(f"has {len(values)} numbers", key=key, expected=f"{count} numbers")


def _compiled(pattern: str, key: str) -> re.Pattern[str]:
    try:
        return re.compile(pattern)
    except re.error as error:
        raise ConfigError(
            f"'{pattern}' is not a regular expression: {error}", key=key, expected="a regular expression"
        ) from error
