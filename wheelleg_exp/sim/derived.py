"""Properties of the robot's state that are worked out when asked for, once between two changes of the state."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import torch


def derived(compute: Callable[[Any], torch.Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def get(self: Any) -> torch.Tensor:
        value = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    return property(get, doc=compute.__doc__)


def same_as(name: str) -> property:
    """Make a property that is another one under a second name of Isaac Lab's."""
    return property(attrgetter(name), doc=f"Same as ``{name}``.")
