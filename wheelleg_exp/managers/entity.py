"""Which member of the scene a term looks at, and which of its joints and bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch

from wheelleg_exp.constraints import Interval, Names
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.sim.scene import Scene
from wheelleg_exp.terms.values import require_fit

Ids = torch.Tensor | slice


@dataclass
class SceneEntityCfg:
    """A member of the scene, with joints and bodies by expression.

    Args:
        name: the member's name, ``robot``, ``terrain`` or a sensor's.
        joint_names: joint expressions; null is all.
        body_names: body expressions; null is all.
        preserve_order: order by expression (True) or by the asset (False).
    """

    name: str
    joint_names: Names | None = None
    body_names: Names | None = None
    preserve_order: bool = False
    joint_ids: Ids = field(default_factory=lambda: slice(None), init=False, repr=False)
    body_ids: Ids = field(default_factory=lambda: slice(None), init=False, repr=False)

    def resolve(self, scene: Scene, path: str) -> None:
        """Find the indices in the scene.

        Args:
            scene: the scene.
            path: config key of this entity, for messages.

        Raises:
            ConfigError: no such member, or an expression matches nothing.
        """
        entity = member(scene, self.name, f"{path}.name")
        if self.joint_names is not None:
            if not hasattr(entity, "find_joints"):
                raise ConfigError(f"'{self.name}' has no joints", key=f"{path}.joint_names", expected="body_names only")
            found = entity.find_joints(
                _listed(self.joint_names), key=f"{path}.joint_names", preserve_order=self.preserve_order
            )
            self.joint_ids = torch.tensor(found[0], device=scene.device)
        if self.body_names is not None:
            found = entity.find_bodies(
                _listed(self.body_names), key=f"{path}.body_names", preserve_order=self.preserve_order
            )
            self.body_ids = torch.tensor(found[0], device=scene.device)

    def selects_as(self, other: SceneEntityCfg) -> bool:
        """Return whether another entity names the same joints and bodies in the same order."""
        names = ("name", "joint_names", "body_names", "preserve_order")
        return all(getattr(self, name) == getattr(other, name) for name in names)


def member(scene: Scene, name: str, key: str) -> Any:
    """Return a member of the scene by name; ConfigError at ``key`` when there is none."""
    if name not in list(scene):
        raise ConfigError(
            f"the scene has no '{name}'",
            key=key,
            expected="one of " + ", ".join(scene),
            nearest=nearest_name(name, scene),
        )
    return scene[name]


def _listed(names: str | Sequence[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def bounds(
    ranges: Mapping[Any, Sequence[float]], axes: Sequence[str], key: str, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return lows and highs (k,) of named ranges on a device; an axis that is not named is (0, 0).

    Raises:
        ConfigError: an axis is unknown or a range is not two numbers in order.
    """
    require_fit(key, ranges, Mapping[Literal[tuple(axes)], Interval])  # type: ignore[misc]
    pairs = torch.tensor([list(ranges.get(axis, (0.0, 0.0))) for axis in axes], dtype=torch.float32, device=device)
    return pairs[:, 0], pairs[:, 1]
