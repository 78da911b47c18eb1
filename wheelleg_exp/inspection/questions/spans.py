"""Lengths of time and places on the time line as words: ``0.5s``, ``200ms``, ``30steps``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from wheelleg_exp.errors import WheellegError

_WORDS = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*")
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3}
_STEPS = ("step", "steps")


@dataclass(frozen=True)
class Length:
    """A length of simulated time, or a number of control steps.

    Attributes:
        value: seconds, or steps.
        is_steps: which.
    """

    value: float
    is_steps: bool

    def steps(self, step_dt: float | None) -> int:
        """Return the nearest number of control steps of ``step_dt`` seconds.

        Raises:
            WheellegError: it is in seconds, and how long a step lasts is not known.
        """
        if self.is_steps:
            return round(self.value)
        if not step_dt:
            raise WheellegError(
                "how long a step lasts is not known of this recording",
                key=f"{self.value:g}s",
                expected="steps: 30steps",
            )
        return round(self.value / step_dt)


def parse_length(text: str, key: str) -> Length:
    """Return the length that a text says; without a unit in seconds.

    Raises:
        WheellegError: it says none.
    """
    match = _WORDS.fullmatch(text)
    if match and match.group(2) in (*_SECONDS, *_STEPS) and math.isfinite(float(match.group(1))):
        value, unit = float(match.group(1)), match.group(2)
        return Length(value, True) if unit in _STEPS else Length(value * _SECONDS[unit], False)
    raise WheellegError(
        f"'{text}' is no length of time", key=key, expected="a number with s, ms or steps, such as 0.5s"
    )
