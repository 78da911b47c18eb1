"""Match names of joints and bodies against regular expressions, with the rules of Isaac Lab's string utilities."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from re import _parser  # type: ignore[attr-defined]
from typing import TypeVar

from wheelleg_exp.errors import ConfigError, nearest_name

T = TypeVar("T")
D = TypeVar("D")


def match_names(
    expressions: str | Sequence[str],
    names: Sequence[str],
    *,
    key: str | None = None,
    what: str,
    preserve_order: bool = False,
) -> tuple[list[int], list[str]]:
    """Return the indices and the names that one or several regular expressions match completely.

    They have the order of ``names``, or with ``preserve_order`` that of the expressions. Raise ConfigError, with the
    config key ``key`` and the noun ``what``, if an expression matches no name, or two expressions match one name.
    """
    patterns = [expressions] if isinstance(expressions, str) else list(expressions)
    owner: dict[str, str] = {}
    ordered: list[str] = []
    for pattern in patterns:
        matched = list(filter(compiled(pattern, names, key).fullmatch, names))
        if not matched:
            some = f"an expression that matches some of: {', '.join(names)}"
            message, nearest = f"the {what} expression '{pattern}' matches nothing", nearest_name(pattern, names)
            expected = some if names else f"nothing: no {what} exists"
            raise ConfigError(message, key=key, expected=expected, nearest=nearest)
        for name in matched:
            if name in owner:
                message = f"{what} '{name}' is matched by both '{owner[name]}' and '{pattern}'"
                raise ConfigError(message, key=key, expected="expressions that do not overlap")
            owner[name] = pattern
        ordered += matched
    chosen = ordered if preserve_order else [name for name in names if name in owner]
    return [names.index(name) for name in chosen], chosen


def values_by_name(
    values: float | Mapping[str, T], names: Sequence[str], default: D, *, key: str, what: str
) -> list[float | T | D]:
    """Return one value for each name, given one number or a mapping from regular expressions to values.

    A name without a match gets ``default``. Raise ConfigError if an expression is invalid or matches no name.
    """
    if not isinstance(values, Mapping):
        return [values] * len(names)
    spread: list[float | T | D] = [default] * len(names)
    match_names(list(values), names, key=key, what=what)
    for pattern, value in values.items():
        for index in match_names(pattern, names, key=key, what=what)[0]:
            spread[index] = value
    return spread


def valueless_errors(values: object, names: Sequence[str], key: str) -> list[ConfigError]:
    """Return an error if a mapping from regular expressions to values leaves joints without a value."""
    if not isinstance(values, Mapping):
        return []
    known = [compiled(str(pattern), names, key) for pattern in values]
    missing = [name for name in names if not any(pattern.fullmatch(name) for pattern in known)]
    message = f"no value for joint {', '.join(missing)}"
    return [ConfigError(message, key=key, expected="one value for each joint")] if missing else []


def order_errors(order: Sequence[object], joints: Sequence[str]) -> list[ConfigError]:
    """Check that ``env.robot.joint_order`` lists each of the robot's joints once; return the errors."""
    key, expected = "env.robot.joint_order", "each of " + ", ".join(joints) + " once"
    unknown = [(f"the robot has no joint '{n}'", nearest_name(str(n), joints)) for n in order if n not in joints]
    errors = [ConfigError(message, key=key, expected=expected, nearest=nearest) for message, nearest in unknown]
    meant = {nearest for _, nearest in unknown}
    missing = [name for name in joints if name not in order and name not in meant]
    twice = sorted({str(name) for name in order if order.count(name) > 1})
    if missing:
        errors.append(ConfigError(f"lacks {', '.join(missing)}", key=key, expected=expected))
    if twice:
        errors.append(ConfigError(f"names {', '.join(twice)} more than once", key=key, expected=expected))
    return errors


def shared_errors(claims: Iterable[tuple[str, str, Sequence[str]]], expected: str) -> list[ConfigError]:
    """Return an error for each joint that two of the ``claims`` (name, config key, driven joints) drive at once."""
    owner: dict[str, str] = {}
    errors = []
    for name, key, joints in claims:
        for joint in joints:
            if owner.setdefault(joint, name) != name:
                message = f"joint '{joint}' is driven by both '{owner[joint]}' and '{name}'"
                errors.append(ConfigError(message, key=key, expected=expected))
    return errors


_MOST_WAYS = 2e7  # Python tries them in about a second.


def compiled(pattern: str, names: Iterable[str], key: str | None = None) -> re.Pattern[str]:
    """Compile a regular expression; raise ConfigError if it is invalid, or too slow to match the longest name."""
    try:
        found = re.compile(pattern)
        ways = _ways(_parser.parse(pattern), max(map(len, names), default=0))
    except (re.error, RecursionError, OverflowError) as error:
        message = f"'{pattern}' is not a regular expression: {error}"
        raise ConfigError(message, key=key, expected="a regular expression") from error
    if ways > _MOST_WAYS:
        message = f"'{pattern}' can match a name in too many ways"
        raise ConfigError(message, key=key, expected="an expression with fewer repetitions, or the names themselves")
    return found


def _ways(pattern: _parser.SubPattern, longest: int) -> float:
    """Return an upper bound of the ways in which a parsed regular expression matches ``longest`` letters."""
    ways = 1.0
    for kind, value in pattern:
        if str(kind) == "BRANCH":
            ways *= sum(_ways(part, longest) for part in value[1])
        elif str(kind).endswith("REPEAT"):
            low, high = (min(int(count), longest) for count in value[:2])
            ways *= min(_ways(value[2], longest), _MOST_WAYS) ** min(high, 40) * (high - low + 1)
        else:
            inner = value if isinstance(value, tuple) else (value,)
            ways *= math.prod(_ways(part, longest) for part in inner if isinstance(part, _parser.SubPattern))
    return ways
