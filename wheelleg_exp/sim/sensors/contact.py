"""Net normal contact forces on bodies, sampled after each physics step."""

from __future__ import annotations

import functools
from collections.abc import Callable
from itertools import product
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from wheelleg_exp.constraints import Count, Names, Natural, NonNegative
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.memory import require_memory
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.sim.sensors.base import SensorBase
from wheelleg_exp.sim.sensors.contact_data import ContactSensorData
from wheelleg_exp.sim.sensors.contact_pairs import FIELDS, NORMAL, ContactPairs, data_flags, summed, width
from wheelleg_exp.sim.terrain import GROUND

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot

_WIDTH = width(NORMAL)


class ContactSensor(SensorBase):
    """Sum of the normal contact forces on each body, world axes, over the last physics step; friction excluded.

    Args:
        body_names: expressions of the sensed bodies.
        history_length: physics steps kept, newest first.
        track_air_time: whether to time contact and flight.
        force_threshold: force above which a body is in contact, N.
        max_contacts: most contacts of one body that are summed.
        update_period: time between two measurements, s; 0 measures after every physics step.
        filter_body_names: expressions of the bodies, ``ground`` among them, from which forces are told apart; null is
            none.
        track_pose: whether the data has the bodies' poses.
        track_contact_points: whether the data has the mean place of the contacts with each filtered body.
        track_friction_forces: whether the data has the friction from each filtered body.

    Attributes:
        data: what was measured, from ``connect`` on.
    """

    data: ContactSensorData
    _norms: list[torch.Tensor | None]  # of each step kept, once asked for
    _largest_norm: torch.Tensor | None

    def __init__(
        self,
        body_names: Names,
        history_length: Natural,
        track_air_time: bool,
        force_threshold: NonNegative,
        max_contacts: Count,
        update_period: NonNegative = 0.0,
        filter_body_names: Names | None = None,
        track_pose: bool = False,
        track_contact_points: bool = False,
        track_friction_forces: bool = False,
    ) -> None:
        super().__init__(update_period)
        filters = filter_body_names or []
        self._filters = [filters] if isinstance(filters, str) else list(filters)
        self._track_pose = track_pose
        self._tracked = {"track_contact_points": track_contact_points, "track_friction_forces": track_friction_forces}
        self._expressions = body_names
        self._history_length = max(1, history_length)
        self.track_air_time = track_air_time
        self.force_threshold = force_threshold
        self._slots = max_contacts

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        """Find the sensed bodies and add one MuJoCo contact sensor a body."""
        super().add_to(spec, name, robot)
        _, self.body_names = robot.find_bodies(self._expressions, key=f"{self.key}.body_names")
        numbers = len(self.body_names) * self._slots * _WIDTH
        require_memory(8 * numbers, f"{self.key}.max_contacts", f"{numbers:,} readings of contacts")
        self._robot, key = robot, f"{self.key}.filter_body_names"
        self.filter_names: list[str] = []
        if self._filters:
            _, self.filter_names = match_names(self._filters, [GROUND, *robot.body_names], key=key, what="body")
        self._require_filters()
        for body in self.body_names:
            self._sense(spec, body, NORMAL, {})
        for body, other in product(self.body_names, self.filter_names):
            ref = "world" if other == GROUND else other
            to = {"reftype": mujoco.mjtObj.mjOBJ_BODY, "refname": ref}
            self._sense(spec, body, self._fields_of_pairs, to, f"/{other}")

    @property
    def _fields_of_pairs(self) -> tuple[str, ...]:
        return FIELDS if any(self._tracked.values()) else NORMAL

    def _require_filters(self) -> None:
        for name, is_tracked in self._tracked.items():
            if is_tracked and not self._filters:
                raise ConfigError(
                    "needs the bodies whose contacts are told apart",
                    key=f"{self.key}.{name}",
                    expected=f"false, or bodies or ground in {self.key}.filter_body_names",
                )

    def _sense(
        self, spec: mujoco.MjSpec, body: str, fields: tuple[str, ...], ref: dict[str, Any], suffix: str = ""
    ) -> None:
        spec.add_sensor(
            name=f"{self.name}/{body}{suffix}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=body,
            intprm=[data_flags(fields), 0, self._slots],
            **ref,
        )

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled."""
        super().connect(sim, stream)
        n, bodies, device = sim.num_envs, len(self.body_names), sim.device
        numbers = 3 * n * bodies * self._history_length
        require_memory(4 * numbers, f"{self.key}.history_length", f"{numbers:,} numbers of past forces")
        start = int(sim.model.sensor(f"{self.name}/{self.body_names[0]}").adr[0])
        end = start + bodies * self._slots * _WIDTH
        self._readings = sim.view("sensordata")[:, start:end].view(n, bodies, self._slots, _WIDTH)
        self._pressures, self._normals = self._readings[..., 1].unsqueeze(2), self._readings[..., 4:7]
        self._counts = self._readings[:, :, 0, 0]
        self.data = ContactSensorData(self.key, n, bodies, self._history_length, self.track_air_time, device)
        if self.filter_names:
            self._connect_pairs(sim.view("sensordata")[:, end:])
        if self._track_pose:
            self.data.add_pose(self._robot, self.body_names)
        self._norms, self._largest_norm = [None] * self._history_length, None
        self._found = torch.zeros(n, bodies, dtype=sim.dtype, device=device)

    def _connect_pairs(self, behind: torch.Tensor) -> None:
        fields, bodies, others = self._fields_of_pairs, len(self.body_names), len(self.filter_names)
        form = len(behind), bodies * others, self._slots, width(fields)
        self._pairs = ContactPairs(behind[:, : form[1] * form[2] * form[3]].view(form), bodies, fields)
        self.data.add_filters(others, **self._tracked)

    def max_force_norm(self) -> torch.Tensor:
        """Largest norm over the history, N, (N, B)."""
        if self._largest_norm is None:
            self._largest_norm = functools.reduce(torch.maximum, map(self._norm, range(self._history_length)))
        return self._largest_norm

    def _forget_norms(self) -> None:
        self._norms[:] = [None] * self._history_length
        self._largest_norm = None

    def _norm(self, age: int) -> torch.Tensor:
        norm = self._norms[age]
        if norm is None:
            norm = self._norms[age] = torch.linalg.vector_norm(self.data.forces[age], dim=-1)
        return norm

    def compute_first_contact(self, dt: float) -> torch.Tensor:
        """Return which bodies (N, B) touched down within the last ``dt`` seconds."""
        self.data.require_times()
        time = self.data.current_contact_time
        return (time > 0.0) & (time < dt + 1e-8)

    def compute_first_air(self, dt: float) -> torch.Tensor:
        """Return which bodies (N, B) left the ground within the last ``dt`` seconds."""
        self.data.require_times()
        time = self.data.current_air_time
        return (time > 0.0) & (time < dt + 1e-8)

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        """Sample the forces of the physics step that has just run."""
        # The normal points away from the sensed body, and force[0] >= 0 pushes the bodies apart.
        self.data.take_forces(summed(self._pressures, self._normals).neg_().float(), due)
        torch.maximum(self._found, self._counts, out=self._found)
        if due is None:
            self._norms[:] = [None, *self._norms[:-1]]
            self._largest_norm = None
        else:
            self._forget_norms()
        if self.filter_names:
            self._measure_pairs(due)
        if self.track_air_time:
            self._update_times(due, elapsed if isinstance(elapsed, float) else elapsed.unsqueeze(1))

    def _measure_pairs(self, due: torch.Tensor | None) -> None:
        tracked = self._tracked
        self.data.take_pairs(
            self._pairs.normal_forces(),
            self._pairs.points() if tracked["track_contact_points"] else None,
            self._pairs.friction_forces() if tracked["track_friction_forces"] else None,
            due,
        )

    def reset(self, ids: torch.Tensor) -> None:
        """Forget forces and times of ``ids``."""
        super().reset(ids)
        self.data.reset(ids)
        self._found.index_fill_(0, ids, 0.0)
        self._norms[:] = [None if norm is None else norm.index_fill(0, ids, 0.0) for norm in self._norms]
        self._largest_norm = None

    def overflowed(self, ids: torch.Tensor) -> torch.Tensor:
        """Return which of ``ids`` had more contacts on one body than ``max_contacts`` since their reset, (n,) bool."""
        return (self._found.index_select(0, ids) > self._slots).any(dim=1)

    def diagnostics(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return ``overflow``: the share of ``env_ids`` with more contacts on one body than the sensor sums."""
        return {"overflow": self.overflowed(env_ids).mean(dtype=torch.float32)}

    def state_dict(self) -> dict[str, Any]:
        """Return the force history and the times."""
        return {
            **super().state_dict(),
            "history": self.data.net_forces_w_history.clone(),
            "found": self._found.clone(),
            **{name: value.clone() for name, value in self.data.times.items()},
            **{name: value.clone() for name, value in self.data.of_pairs().items()},
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self.data.set_forces(list(saved["history"].clone().unbind(dim=1)))
        self._found.copy_(saved["found"])
        for name, value in self.data.times.items():
            value.copy_(saved[name])
        for name in self.data.of_pairs():
            setattr(self.data, name, saved[name].clone())
        self._forget_norms()

    def _update_times(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        contact = torch.linalg.vector_norm(self.data.net_forces_w, dim=-1) > self.force_threshold
        for mode, active in (("contact", contact), ("air", ~contact)):
            current, last = self.data.times[f"current_{mode}_time"], self.data.times[f"last_{mode}_time"]
            self._advance(current, last, active, elapsed, due)

    def _advance(
        self,
        current: torch.Tensor,
        last: torch.Tensor,
        active: torch.Tensor,
        elapsed: float | torch.Tensor,
        due: torch.Tensor | None,
    ) -> None:
        """Count the time in a mode; where it has just ended, keep its duration."""
        ended = ~active & (current > 0.0)
        lasted, counted = torch.where(ended, current + elapsed, last), torch.where(active, current + elapsed, 0.0)
        if due is not None:
            rows = due.unsqueeze(1)
            lasted, counted = torch.where(rows, lasted, last), torch.where(rows, counted, current)
        last.copy_(lasted)
        current.copy_(counted)
