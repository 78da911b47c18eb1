"""The interface of an engine: N simulations of one MuJoCo model, with states as tensors on one device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import mujoco
import torch

from wheelleg_exp.sim.options import RobotOptions, SimOptions
from wheelleg_exp.state import Stateful

WRENCHES = "wrenches"


class Engine(Stateful, ABC):
    """N simulations of one model.

    State fields are always current. Once code has called ``derived``, each physics step also updates quantities such as
    ``xpos`` and ``cvel``. Torques and contact forces belong to the last physics step, as in PhysX and Isaac Lab.

    Attributes:
        name: the engine's name in ``env.sim.engine``.
        exact: whether repeating a simulation gives bit-identical results.
        model: the compiled CPU model: names, ids, digests, defaults.
        state: the numbers that determine the next step, one row per simulation, (N, k).
        expanded: the model fields that have one value per simulation, (N, ...) by name.
        asked: model fields and ``WRENCHES`` that terms have obtained; the event manager clears it after each term.
    """

    name: ClassVar[str]
    exact: bool
    model: mujoco.MjModel
    num_envs: int
    device: torch.device
    dtype: torch.dtype
    state: torch.Tensor
    nthread: int
    expanded: dict[str, torch.Tensor]
    asked: set[str]

    @classmethod
    @abstractmethod
    def from_config(cls, model: mujoco.MjModel, num_envs: int, sim: SimOptions, robot: RobotOptions, /) -> Engine:
        """Start N simulations of a model. Other parameters are keys of the node ``env.sim.engine``."""

    def constant(self, name: str) -> torch.Tensor:
        """Return a copy of a field of the compiled model on the engine's device; float fields are cast to ``dtype``."""
        field = torch.from_numpy(getattr(self.model, name).copy())
        return field.to(self.device, self.dtype if field.is_floating_point() else None)

    def promise(self) -> dict[str, object]:
        """Return the engine's entry in a run's manifest: name, version, device, and whether it is bit-reproducible."""
        version = mujoco.mj_versionString()
        return {"name": self.name, "version": version, "device": str(self.device), "exact": self.exact}

    def robot_differences(self) -> list[str]:
        """Return how the simulated robots differ from the model's robots, one text per property."""
        return []

    @abstractmethod
    def view(self, name: str) -> torch.Tensor:
        """Return a view (N, ...) of an MjData field, which always shows the present values.

        Code may write to the state fields (``qpos``, ``qvel``, ``ctrl``, ``xfrc_applied``, ...). All others are outputs
        of the last physics step, which ``forward`` overwrites.
        """

    @property
    def motion(self) -> torch.Tensor:
        """Present positions and velocities of the simulations, (N, nq + nv), with the positions first."""
        return torch.cat((self.view("qpos"), self.view("qvel")), dim=1)

    @abstractmethod
    def derived(self, name: str) -> torch.Tensor:
        """Return a view (N, ...) of a quantity such as ``xpos``, which each physics step updates from now on."""

    def may_differ(self, name: str) -> bool:
        """Return whether a model field can have one value per simulation."""
        return hasattr(self.model, name)

    @abstractmethod
    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value per simulation; return the tensor (N, ...), to which events can write.

        Call ``set_const`` after writing masses, inertias, centres of mass, or armatures: constants depend on them.
        """

    @abstractmethod
    def set_const(self) -> None:
        """Recompute, in each simulation, the constants that MuJoCo derives from model fields."""

    @abstractmethod
    def step(self) -> None:
        """Advance every simulation by one physics step; raise SimulationFailure if the engine fails."""

    @property
    def is_captured(self) -> bool:
        """Whether the engine's physics step can be part of a captured CUDA graph."""
        return False

    def require_room(self) -> None:
        """Raise SimulationFailure if the contacts or constraint rows of a simulation exceeded the engine's capacity."""

    @abstractmethod
    def forward(self, ids: torch.Tensor | None = None) -> None:
        """Recompute all quantities that depend on the states of the simulations ``ids``; None means all simulations."""

    @abstractmethod
    def reset(self, ids: torch.Tensor) -> None:
        """Zero the time, controls, applied forces, warm start and warnings of the simulations ``ids``.

        NaN and inf in positions and velocities become the model's defaults; finite values do not change.
        """

    @abstractmethod
    def unstable(self) -> torch.Tensor:
        """Return a mask (N,) of the simulations that have had NaN or huge values since their last reset."""

    def total(self, rows: torch.Tensor | slice) -> torch.Tensor:
        """Return a number that is NaN or inf if a position or velocity of the simulations ``rows`` is NaN or inf."""
        return self.view("qpos")[rows].sum() + self.view("qvel")[rows].sum()

    @abstractmethod
    def ray(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: Sequence[int] | None = None,
        ids: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the distance to each ray's first hit, (n, R), in lengths of the ray's direction; -1 means no hit.

        ``origins``, m, and ``directions`` are (n, R, 3) in world axes, for the simulations ``ids`` (n,), by default
        all. If ``geom_groups`` is not None, only geoms in these groups stop a ray.
        """

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        """Declare that a group's geoms never move, so that rays against them can be cast in a model without the robot.

        ``alone`` returns a MuJoCo model that contains only the group's geoms, with unchanged names.
        """
        del geom_group, alone
