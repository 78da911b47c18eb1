"""The interface of an engine: N simulations of one model, visible as live tensors on one device."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import mujoco
import torch

from wheelleg_exp.state import Kept

WRENCHES = "wrenches"


class Engine(Kept, ABC):
    """N simulations of one model.

    State fields are always current. Outputs that depend on positions and velocities are updated after each step once a
    term has read one of them (``derived``); before that they cost nothing. Torques and contact forces keep the values
    of the last solve, which is the convention of PhysX and Isaac Lab.

    Attributes:
        name: the engine's name in ``env.sim.engine``.
        exact: whether repeating a simulation gives bit-identical results.
        model: the compiled CPU model: names, ids, digests, defaults.
        num_envs: number of simulations, N.
        device: device of all tensors.
        dtype: type of the engine's numbers.
        state: the numbers that determine the next step, one row per simulation, (N, k).
        nthread: CPU threads that step the simulations.
        expanded: the model fields that have one value per simulation, (N, ...) by name.
        asked: the tensors other than states that terms obtained to write to: model fields by name, ``WRENCHES``. The
            reader of this set empties it.
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

    def constant(self, name: str) -> torch.Tensor:
        """Return a copy of a field of the compiled model on the engine's device; floats are converted to ``dtype``."""
        field = torch.from_numpy(getattr(self.model, name).copy())
        return field.to(self.device, self.dtype if field.is_floating_point() else None)

    def promise(self) -> dict[str, Any]:
        """Return the engine's entry in a run's manifest: name, device, and whether it is bit-reproducible."""
        return {"name": self.name, "device": str(self.device), "exact": self.exact}

    @abstractmethod
    def view(self, name: str) -> torch.Tensor:
        """Return a live view (N, ...) of an MjData field.

        State fields (``qpos``, ``qvel``, ``ctrl``, ``xfrc_applied``, ...) may be written. Other fields are outputs of
        the last step. Read them before the next call of ``forward``, which overwrites them.
        """

    @property
    def motion(self) -> torch.Tensor:
        """Present positions, then velocities, (N, nq + nv)."""
        return torch.cat((self.view("qpos"), self.view("qvel")), dim=1)

    @abstractmethod
    def derived(self, name: str) -> torch.Tensor:
        """Return a live view (N, ...) of an output that depends on positions and velocities; each step updates it."""

    def may_differ(self, name: str) -> bool:
        """Return whether a model field can have one value per simulation."""
        return hasattr(self.model, name)

    @abstractmethod
    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value per simulation; return the live tensor (N, ...).

        Call ``set_const`` after writing a field that constants depend on (masses, inertias, centres of mass).
        """

    @abstractmethod
    def set_const(self) -> None:
        """Recompute the constants that MuJoCo derives from the model fields of each simulation."""

    @abstractmethod
    def step(self) -> None:
        """Advance every simulation by one physics step.

        Raises:
            SimulationFailure: the engine raised an error.
        """

    @property
    def is_captured(self) -> bool:
        """Whether a control step, including the engine's steps, can be captured as a CUDA graph."""
        return False

    def require_room(self) -> None:
        """Raise SimulationFailure if contacts or constraint rows exceeded the engine's capacity."""

    @abstractmethod
    def forward(self, ids: torch.Tensor | None = None) -> None:
        """Recompute derived outputs for the present state of ``ids`` (None means all)."""

    @abstractmethod
    def reset(self, ids: torch.Tensor) -> None:
        """Zero time, controls, applied forces, warm start and warnings of ``ids``; keep positions and velocities.

        Positions and velocities that are NaN or inf become the model's defaults.
        """

    @abstractmethod
    def unstable(self) -> torch.Tensor:
        """Return which simulations, (N,) bool, have had NaN or huge values since their reset."""

    def total(self, rows: torch.Tensor | slice) -> torch.Tensor:
        """Return one sum that is finite only if all positions and velocities of the simulations ``rows`` are finite."""
        return self.view("qpos")[rows].sum() + self.view("qvel")[rows].sum()

    @abstractmethod
    def ray(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: Sequence[int] | None = None,
        ids: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the distance of each ray's first hit, in lengths of its direction, (n, R); -1 is a miss.

        Args:
            origins: world, m, (n, R, 3).
            directions: world, (n, R, 3).
            geom_groups: MuJoCo's groups of the geoms that stop a ray; None means all groups.
            ids: the simulations of the rays, (n,); None means all simulations.
        """

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        """Declare that the geoms of a group never move, so that their rays may be cast in a model without the robot.

        This is an optimisation: an engine may ignore it.

        Args:
            geom_group: the group.
            alone: returns a model that contains only these geoms, with the same names.
        """
        del geom_group, alone

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that determines the next step."""

    @abstractmethod
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
