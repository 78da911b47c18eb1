"""What the scene asks of an engine: N simulations of one model, seen as live tensors on one device."""

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

    State fields are always current. Position- and velocity-dependent outputs are computed for the new state once some
    term has asked for one (``derived``), and cost nothing before. Torques and contact forces keep the values of the
    last solve, which is the convention of PhysX and Isaac Lab.

    Attributes:
        name: what ``env.sim.engine`` calls it.
        exact: whether the same steps from the same state give the same bits.
        model: the compiled model in the host's memory: names, ids, digests, defaults.
        num_envs: number of simulations, N.
        device: where all tensors are.
        dtype: type of the engine's numbers.
        state: one row of numbers a simulation, from which its next step follows, (N, k).
        nthread: threads of the host that step the simulations.
        expanded: the model fields that have one value a simulation, (N, ...) by name.
        asked: what somebody has asked for to write beside states, until somebody empties it: model fields by name,
            ``WRENCHES``.
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
        """Return a copy of a field of the compiled model, as MuJoCo has it; numbers with a point in ``dtype``."""
        field = torch.from_numpy(getattr(self.model, name).copy())
        return field.to(self.device, self.dtype if field.is_floating_point() else None)

    def promise(self) -> dict[str, Any]:
        """Return what a run records of its engine: its name, where it ran, and whether it repeats to the bit."""
        return {"name": self.name, "device": str(self.device), "exact": self.exact}

    @abstractmethod
    def view(self, name: str) -> torch.Tensor:
        """Return a live view (N, ...) of an MjData field.

        State fields (``qpos``, ``qvel``, ``ctrl``, ``xfrc_applied``, ...) may be written. Others are outputs of the
        last step, and must only be read, before ``forward`` is called: it leaves other simulations' values in them.
        """

    @property
    def motion(self) -> torch.Tensor:
        """Positions, then velocities, as they are now, (N, nq + nv)."""
        return torch.cat((self.view("qpos"), self.view("qvel")), dim=1)

    @abstractmethod
    def derived(self, name: str) -> torch.Tensor:
        """Return a live view (N, ...) of an output that depends on positions and velocities; it is kept current."""

    def may_differ(self, name: str) -> bool:
        """Return whether a model field can have one value a simulation."""
        return hasattr(self.model, name)

    @abstractmethod
    def expand(self, name: str) -> torch.Tensor:
        """Give a model field one value a simulation; return the live tensor (N, ...).

        Call ``set_const`` after writing a field that constants are derived from (masses, inertias, CoM).
        """

    @abstractmethod
    def set_const(self) -> None:
        """Recompute the constants that are derived from the model fields of each simulation."""

    @abstractmethod
    def step(self) -> None:
        """Advance every simulation by one physics step.

        Raises:
            SimulationFailure: the engine raised an error.
        """

    @property
    def is_captured(self) -> bool:
        """Whether an environment's step may be captured as a CUDA graph, the engine's steps within it."""
        return False

    def require_room(self) -> None:
        """Raise SimulationFailure when there were more contacts or constraint rows than there is room for."""

    @abstractmethod
    def forward(self, ids: torch.Tensor | None = None) -> None:
        """Make derived outputs describe the present state of ``ids`` (all when None)."""

    @abstractmethod
    def reset(self, ids: torch.Tensor) -> None:
        """Zero time, controls, applied forces, warm start and warnings of ``ids``; positions and velocities stay.

        Values that are not finite become the model's defaults.
        """

    @abstractmethod
    def unstable(self) -> torch.Tensor:
        """Return which simulations (N,) bool have gone to NaN or huge values since their reset."""

    def total(self, rows: torch.Tensor | slice) -> torch.Tensor:
        """Return a number that is finite only where positions, velocities and more of some simulations all are."""
        return self.view("qpos")[rows].sum() + self.view("qvel")[rows].sum()

    @abstractmethod
    def ray(
        self,
        origins: torch.Tensor,
        directions: torch.Tensor,
        geom_groups: Sequence[int] | None = None,
        ids: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return how far rays go before they meet a geom, in lengths of their direction, (n, R); -1 is a miss.

        Args:
            origins: world, m, (n, R, 3).
            directions: world, (n, R, 3).
            geom_groups: MuJoCo's groups of the geoms that stop a ray; None is all.
            ids: the simulations that the rays are in, (n,); None is all.
        """

    def cast_alone(self, geom_group: int, alone: Callable[[], mujoco.MjModel]) -> None:
        """Say that a group's geoms never move: rays onto this group may be cast in a model of them alone.

        An engine may leave it be, since no result depends on it.

        Args:
            geom_group: the group.
            alone: returns the model of these geoms, by the same names.
        """
        del geom_group, alone

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return everything that the next step depends on."""

    @abstractmethod
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
