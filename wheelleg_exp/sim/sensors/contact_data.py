"""What a contact sensor has measured, under Isaac Lab's names."""

from __future__ import annotations

from typing import TYPE_CHECKING, NoReturn

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Kept

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot

TIMES = ("current_air_time", "last_air_time", "current_contact_time", "last_contact_time")


def _time(name: str, doc: str) -> property:
    """Make a property that is there when the sensor times contact and flight."""

    def get(self: ContactSensorData) -> torch.Tensor:
        self.require_times()
        return self.times[name]

    return property(get, doc=doc)


class ContactSensorData(Kept):
    """What a contact sensor has measured of N environments and B bodies; ``_w`` is world axes.

    What the sensor is not told to track raises ConfigError when it is asked for.

    Args:
        key: the sensor's config key.
        num_envs: number of environments, N.
        bodies: number of sensed bodies, B.
        history_length: physics steps kept, T.
        track_air_time: whether contact and flight are timed.
        device: where the tensors are.

    Attributes:
        forces: net normal force of each step kept, N, (N, B, 3), newest first.
        filtered: ``force_matrix_w_history``; None when forces are not told apart.
        points: ``contact_pos_w``; None when it is not tracked.
        friction: ``friction_forces_w``; None when it is not tracked.
        times: the four times by name, s, (N, B); zeros when they are not tracked.
    """

    def __init__(
        self, key: str, num_envs: int, bodies: int, history_length: int, track_air_time: bool, device: torch.device
    ) -> None:
        self._key = key
        self.forces = [torch.zeros(num_envs, bodies, 3, device=device) for _ in range(history_length)]
        self._history: torch.Tensor | None = None  # of the same forces, once asked for
        self._track_air_time = track_air_time
        self.filtered: torch.Tensor | None = None
        self.points: torch.Tensor | None = None
        self.friction: torch.Tensor | None = None
        self._robot: Robot | None = None
        self.times = {name: torch.zeros(num_envs, bodies, device=device) for name in TIMES}

    @property
    def net_forces_w(self) -> torch.Tensor:
        """Net normal force of the last physics step, N, (N, B, 3)."""
        return self.forces[0]

    @property
    def net_forces_w_history(self) -> torch.Tensor:
        """Net normal force, N, (N, T, B, 3), newest first."""
        if self._history is None:
            self._history = torch.stack(self.forces, dim=1)
            self.forces[:] = self._history.unbind(dim=1)
        return self._history

    def set_forces(self, forces: list[torch.Tensor]) -> None:
        """Let the forces of the steps kept be others, each (N, B, 3), newest first."""
        self.forces[:] = forces  # the list stays: a recorded part of a step knows it
        self._history = None

    def take_forces(self, newest: torch.Tensor, due: torch.Tensor | None) -> None:
        """Take up a sample (N, B, 3), of the environments ``due`` (N,) alone where not of all, and drop the oldest."""
        kept = [newest, *self.forces[:-1]]
        if due is not None:
            rows = due.view(-1, 1, 1)
            kept = [torch.where(rows, after, before) for after, before in zip(kept, self.forces, strict=True)]
        self.set_forces(kept)

    current_air_time = _time("current_air_time", "Time since the body left the ground, s, 0 in contact, (N, B).")
    last_air_time = _time("last_air_time", "Duration of the last flight, s, (N, B).")
    current_contact_time = _time("current_contact_time", "Time since the body touched down, s, 0 in the air, (N, B).")
    last_contact_time = _time("last_contact_time", "Duration of the last contact, s, (N, B).")

    def add_filters(self, count: int, track_contact_points: bool, track_friction_forces: bool) -> None:
        """Tell the contacts with ``count`` other bodies apart."""
        n, bodies, _ = self.net_forces_w.shape
        self.filtered = self.net_forces_w.new_zeros(n, len(self.forces), bodies, count, 3)
        self.points = torch.full_like(self.filtered[:, 0], torch.nan) if track_contact_points else None
        self.friction = torch.zeros_like(self.filtered[:, 0]) if track_friction_forces else None

    def take_pairs(
        self,
        newest: torch.Tensor,
        points: torch.Tensor | None,
        friction: torch.Tensor | None,
        due: torch.Tensor | None,
    ) -> None:
        """Take up a sample of what is told apart, each (N, B, M, 3); as ``take_forces``."""
        before = self.force_matrix_w_history
        taken = {
            "filtered": torch.cat((newest.unsqueeze(1), before[:, :-1]), dim=1),
            "points": points,
            "friction": friction,
        }
        for name, value in taken.items():
            if value is not None and due is not None:
                value = torch.where(due.view(-1, *[1] * (value.ndim - 1)), value, getattr(self, name))
            setattr(self, name, value)

    def of_pairs(self) -> dict[str, torch.Tensor]:
        """Return what is told apart, by attribute."""
        found = {"filtered": self.filtered, "points": self.points, "friction": self.friction}
        return {name: value for name, value in found.items() if value is not None}

    def add_pose(self, robot: Robot, bodies: list[str]) -> None:
        """Show the poses of the sensed bodies."""
        self._robot, self._ids = robot, [robot.body_names.index(body) for body in bodies]

    @property
    def force_matrix_w_history(self) -> torch.Tensor:
        """Normal force from each filtered body, N, (N, T, B, M, 3), newest first."""
        if self.filtered is None:
            self._refuse("forces are not told apart", "filter_body_names", "the other bodies, or ground")
        return self.filtered

    @property
    def force_matrix_w(self) -> torch.Tensor:
        """Normal force of the last physics step from each filtered body, N, (N, B, M, 3)."""
        return self.force_matrix_w_history[:, 0]

    @property
    def contact_pos_w(self) -> torch.Tensor:
        """Mean place of the contacts with each filtered body, m, (N, B, M, 3); NaN where there is none."""
        if self.points is None:
            self._refuse("places of contacts are not tracked", "track_contact_points", "true, and filter_body_names")
        return self.points

    @property
    def friction_forces_w(self) -> torch.Tensor:
        """Friction of the last physics step from each filtered body, N, (N, B, M, 3)."""
        if self.friction is None:
            self._refuse("friction is not tracked", "track_friction_forces", "true, and filter_body_names")
        return self.friction

    @property
    def pos_w(self) -> torch.Tensor:
        """Positions of the sensed bodies' frames, m, (N, B, 3)."""
        return self._posed().data.body_pos_w[:, self._ids]

    @property
    def quat_w(self) -> torch.Tensor:
        """Orientations of the sensed bodies' frames (w, x, y, z), (N, B, 4)."""
        return self._posed().data.body_quat_w[:, self._ids]

    def _posed(self) -> Robot:
        if self._robot is None:
            self._refuse("poses are not tracked", "track_pose", "true, for a term that asks for poses")
        return self._robot

    def _refuse(self, message: str, name: str, expected: str) -> NoReturn:
        raise ConfigError(message, key=f"{self._key}.{name}", expected=expected)

    def require_times(self) -> None:
        """Raise ConfigError when contact and flight are not timed."""
        if not self._track_air_time:
            expected = "true, for a term that asks for times or first contacts"
            self._refuse("contact and flight are not timed", "track_air_time", expected)

    def reset(self, ids: torch.Tensor) -> None:
        """Forget forces and times of ``ids``."""
        self.set_forces([force.index_fill(0, ids, 0.0) for force in self.forces])
        for name, value in self.of_pairs().items():
            setattr(self, name, value.index_fill(0, ids, torch.nan if name == "points" else 0.0))
        if self._track_air_time:  # else they are 0
            for value in self.times.values():
                value.index_fill_(0, ids, 0.0)
