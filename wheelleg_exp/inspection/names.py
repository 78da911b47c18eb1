"""Numbers by the names that one types: ``rewards.base_height``, ``rewards/base_height``."""

from __future__ import annotations

import re
from collections.abc import Iterable

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.inspection.frames import Frames
from wheelleg_exp.inspection.selection import Selection
from wheelleg_exp.recording.groups import Number
from wheelleg_exp.recording.reader import Recording

_SHOWN = 12


def find_number(recording: Recording, name: str, env_id: int | None = None, key: str = "--term") -> Number:
    """Return the number of a name.

    Raises:
        WheellegError: there is none, with the nearest that there is.
    """
    numbers = recording.all_numbers(env_id)
    for word in (name, name.strip("/").replace("/", ".")):
        if word in numbers:
            return numbers[word]
    raise WheellegError(
        f"nothing of the name '{name}' was recorded",
        key=key,
        expected=_expected(name, list(numbers)),
        nearest=_nearest(name, list(numbers)),
    )


def frames_for(recording: Recording, names: Iterable[str], selection: Selection, key: str = "--term") -> list[Frames]:
    """Return the chosen rows of numbers, for each chosen environment, by the names that were asked for.

    Raises:
        WheellegError: one of the names is wrong, or the selection is.
    """
    words, found = list(dict.fromkeys(names)), []
    for env_id in selection.env_ids(recording):
        numbers = [find_number(recording, name, env_id, key) for name in words]
        named = [Number(word, n.entity, n.index) for word, n in zip(words, numbers, strict=True)]
        shared = bool(recording.branch(env_id)) and not any(is_of_env(number) for number in numbers)
        found.append(Frames(selection.apply(recording.columns_of(named)), None if shared else env_id))
        if shared:
            break  # these numbers are of no environment
    return found


def is_of_env(number: Number) -> bool:
    """Return whether a number is of one of several recorded environments."""
    return re.match(r"env_\d+/", number.entity) is not None


def _expected(name: str, names: list[str]) -> str:
    """Return those that begin like the name, or what the names begin with."""
    top = name.replace("/", ".").split(".")[0]
    below = [n for n in names if n.startswith(f"{top}.")]
    shown = below or [f"{top}.…" for top in dict.fromkeys(n.split(".")[0] for n in names)]
    return "one of " + ", ".join(shown[:_SHOWN]) + (f", … ({len(shown)} in all)" if len(shown) > _SHOWN else "")


def _nearest(name: str, names: list[str]) -> str | None:
    word = name.replace("/", ".")
    ends = [n for n in names if n.endswith(f".{word}")]
    return min(ends, key=len) if ends else nearest_name(word, names)
