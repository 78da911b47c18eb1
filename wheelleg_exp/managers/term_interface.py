"""The interface of terms: the environment as terms see it, members of the scene, and named ranges."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, Protocol

import torch

from wheelleg_exp.constraints import Interval, Names
from wheelleg_exp.errors import ConfigError, not_one_of
from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.sim.scene import Scene
from wheelleg_exp.terms.config_values import require_fit

if TYPE_CHECKING:
    from wheelleg_exp import managers


class Env(Protocol):
    """The environment, with the attributes that manager terms can use."""

    cfg: Any  # the config section ``env``, by attribute or key
    options: EnvOptions  # the config section ``env``, with a type for each key
    num_envs: int  # number of environments, N
    exact_envs: int  # The environments 0 to ``exact_envs`` - 1 have none of the errors of ``env.realism``.
    prompt_envs: int  # The environments 0 to ``prompt_envs`` - 1 have no delay of the actions.
    device: torch.device
    physics_dt: float  # physics step, s
    step_dt: float  # control step, s
    max_episode_length_s: float  # longest episode, s
    max_episode_length: int  # longest episode, control steps
    episode_length_buf: torch.Tensor  # control steps of each present episode, (N,) long
    common_step_counter: int  # control steps since construction
    scene: Scene
    streams: Streams
    observers: list[Callable[[], None]]  # called in every step after the rewards and before the resets
    command_manager: managers.CommandManager
    action_manager: managers.ActionManager
    observation_manager: managers.ObservationManager
    event_manager: managers.EventManager
    reward_manager: managers.RewardManager
    termination_manager: managers.TerminationManager
    curriculum_manager: managers.CurriculumManager
    recorder_manager: managers.RecorderManager


Ids = torch.Tensor | Sequence[int] | slice


@dataclass
class SceneEntityCfg:
    """A robot or sensor of the scene, with joints and bodies selected by regular expressions.

    Args:
        name: the member's name, ``robot``, ``terrain`` or a sensor's.
        joint_names: joint expressions; null is all. Once resolved, the names.
        joint_ids: indices of the joints, instead of names.
        fixed_tendon_names: must be null, because tendons are not supported.
        fixed_tendon_ids: not used.
        body_names: body expressions; null is all. Once resolved, the names.
        body_ids: indices of the bodies, instead of names.
        object_collection_names: must be null, because collections of objects are not supported.
        object_collection_ids: not used.
        preserve_order: order by expression (True) or by the asset (False).
    """

    name: str
    joint_names: Names | None = None
    joint_ids: Ids = field(default_factory=lambda: slice(None), repr=False)
    fixed_tendon_names: Names | None = field(default=None, repr=False)
    fixed_tendon_ids: Ids = field(default_factory=lambda: slice(None), repr=False)
    body_names: Names | None = None
    body_ids: Ids = field(default_factory=lambda: slice(None), repr=False)
    object_collection_names: Names | None = field(default=None, repr=False)
    object_collection_ids: Ids = field(default_factory=lambda: slice(None), repr=False)
    preserve_order: bool = False

    def resolve(self, scene: Scene, path: str = "SceneEntityCfg") -> None:
        """Find the joints and bodies that match the expressions; errors name the config key ``path``."""
        entity = member(scene, self.name, f"{path}.name")
        if self.joint_names is not None:
            if not hasattr(entity, "find_joints"):
                raise ConfigError(f"'{self.name}' has no joints", key=f"{path}.joint_names", expected="body_names only")
            found = entity.find_joints(self.joint_names, key=f"{path}.joint_names", preserve_order=self.preserve_order)
            self.joint_ids, self.joint_names = torch.tensor(found[0], device=scene.device), found[1]
        if self.body_names is not None:
            found = entity.find_bodies(self.body_names, key=f"{path}.body_names", preserve_order=self.preserve_order)
            self.body_ids, self.body_names = torch.tensor(found[0], device=scene.device), found[1]
        self.joint_ids = _indices(self.joint_ids, len(getattr(entity, "joint_names", ())), scene.device)
        self.body_ids = _indices(self.body_ids, len(getattr(entity, "body_names", ())), scene.device)
        self._bodies = _on_host(self.body_ids, len(getattr(entity, "body_names", ())))
        for name in ("fixed_tendon_names", "object_collection_names"):
            if getattr(self, name) is not None:
                raise ConfigError(f"entity '{self.name}' has no '{name}'", key=f"{path}.{name}", expected="null")

    def body_list(self, count: int) -> list[int]:
        """Return the indices of the selected bodies as a list; after ``resolve``, nothing is copied from the GPU."""
        known = vars(self).get("_bodies")
        return list(known) if known is not None else _on_host(self.body_ids, count)


def member(scene: Scene, name: str, key: str) -> Any:
    """Return a robot or sensor of the scene by name; raise ConfigError with ``key`` if the name does not exist."""
    if name not in list(scene):
        raise not_one_of(f"the scene has no robot or sensor '{name}'", name, scene, key=key)
    return scene[name]


def _indices(ids: Ids, count: int, device: torch.device) -> torch.Tensor | slice:
    """Return joint or body indices as a tensor or a slice; negative indices count from the end, as in Python."""
    if isinstance(ids, (torch.Tensor, slice)):
        return ids
    return torch.tensor([i + count if -count <= i < 0 else i for i in ids], device=device)


def _on_host(ids: Ids, count: int) -> list[int]:
    if isinstance(ids, slice):
        return list(range(count))[ids]
    return ids.tolist() if isinstance(ids, torch.Tensor) else list(ids)


def bounds(
    ranges: Mapping[Any, Sequence[float]], axes: Sequence[str], key: str, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the lower and the upper bounds of k axes, (k,) each; an axis without a range gets [0, 0]."""
    require_fit(key, ranges, Mapping[Literal[tuple(axes)], Interval])  # type: ignore[misc]
    pairs = torch.tensor([list(ranges.get(axis, (0.0, 0.0))) for axis in axes], dtype=torch.float32, device=device)
    return pairs[:, 0], pairs[:, 1]
