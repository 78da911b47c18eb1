"""The contact sensor: net normal contact forces on bodies, contact times, and air times."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from itertools import product
from typing import TYPE_CHECKING, NoReturn

import mujoco
import torch

from wheelleg_exp.constraints import Count, Names, Natural, NonNegative
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import require_memory
from wheelleg_exp.sim.class_members import TensorProperty
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.sim.sensors.sensor_base import ROUNDING, SensorBase
from wheelleg_exp.sim.terrain import GROUND
from wheelleg_exp.state import Stateful

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot


# ``_SIZES`` maps each data field of MuJoCo's contact sensor to the number of its components.
_SIZES = {"found": 1, "force": 3, "pos": 3, "normal": 3, "tangent": 3}
_NORMAL = ("found", "force", "normal")  # Normal contact forces are computed from these sensor fields.
_WIDTH = sum(_SIZES[name] for name in _NORMAL)


def summed(pressures: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Multiply forces (N, B, 1, S) by contact normals (N, B, S, 3), and return the sum over S contacts, (N, B, 3)."""
    if pressures.is_cuda:  # On a GPU, an elementwise product and a sum are ten times faster than ``torch.matmul``.
        return (pressures.transpose(2, 3) * normals).sum(dim=2)
    return torch.matmul(pressures, normals).squeeze(2)


TIMES = ("current_air_time", "last_air_time", "current_contact_time", "last_contact_time")


def _time(name: str, doc: str) -> TensorProperty:
    """Make a property that raises ConfigError unless the sensor tracks contact and air times."""

    def get(self: ContactSensorData) -> torch.Tensor:
        if not self._track_air_time:
            expected = "true, for a term that reads times or first contacts"
            self._refuse("contact and air times are not tracked", "track_air_time", expected)
        return self.times[name]

    return TensorProperty(get, doc=doc)


class ContactSensorData(Stateful):
    """Measurements of a contact sensor for N environments and B bodies; the suffix ``_w`` means world axes.

    Reading a quantity that is not tracked raises ConfigError. ``points``, ``friction``, and ``filtered`` are
    ``contact_pos_w``, ``friction_forces_w``, and ``force_matrix_w_history``; None if not tracked.

    Attributes:
        forces: net normal force of each step in the history, N, (N, B, 3), newest first.
        times: contact and air times by name, s, (N, B); zeros if not tracked.
    """

    def __init__(
        self, key: str, num_envs: int, bodies: int, history_length: int, track_air_time: bool, device: torch.device
    ) -> None:
        self._key = key
        forces = [torch.zeros(num_envs, bodies, 3, device=device) for _ in range(history_length)]
        self.forces = self.buffer("forces", forces)
        # The property ``net_forces_w_history`` sets ``_history``.
        self._history: torch.Tensor | None = self.buffer("_history", None, saved=False)
        self._track_air_time = track_air_time
        self.filtered: torch.Tensor | None = self.buffer("filtered", None)
        self.points: torch.Tensor | None = self.buffer("points", None)
        self.friction: torch.Tensor | None = self.buffer("friction", None)
        # The robot and the indices of its sensed bodies, if the sensor tracks their poses.
        self.posed: tuple[Robot, list[int]] | None = None
        self.times = self.buffer("times", {name: torch.zeros(num_envs, bodies, device=device) for name in TIMES})

    @property
    def net_forces_w(self) -> torch.Tensor:
        """Sum of the normal forces on each sensed body in the last physics step, (N, B, 3), in newtons."""
        return self.forces[0]

    @property
    def net_forces_w_history(self) -> torch.Tensor:
        """Sum of the normal forces on each sensed body in T measurements, (N, T, B, 3), newtons, newest first."""
        if self._history is None:
            self._history = torch.stack(self.forces, dim=1)
            self.forces[:] = self._history.unbind(dim=1)
        return self._history

    def set_forces(self, forces: list[torch.Tensor]) -> None:
        """Replace the force history by a sequence of tensors (N, B, 3), with the newest force first."""
        self.forces[:] = forces  # Keep the list object ``forces``, because recorded CUDA graphs refer to this object.
        self._history = None

    current_air_time = _time("current_air_time", "Time since the body left the ground, s, 0 in contact, (N, B).")
    last_air_time = _time("last_air_time", "Duration of the last flight, s, (N, B).")
    current_contact_time = _time("current_contact_time", "Time since the body touched down, s, 0 in the air, (N, B).")
    last_contact_time = _time("last_contact_time", "Duration of the last contact, s, (N, B).")

    @property
    def force_matrix_w_history(self) -> torch.Tensor:
        """Last T normal forces on each sensed body from each filtered body, (N, T, B, M, 3), newtons, newest first."""
        if self.filtered is None:
            self._refuse("forces are not separated by body", "filter_body_names", "the other bodies, or ground")
        return self.filtered

    @property
    def force_matrix_w(self) -> torch.Tensor:
        """Present normal force on each sensed body from each filtered body, (N, B, M, 3), newtons."""
        return self.force_matrix_w_history[:, 0]

    @property
    def contact_pos_w(self) -> torch.Tensor:
        """Mean contact position of each sensed body with each filtered body, m, (N, B, M, 3); NaN without contact."""
        if self.points is None:
            self._refuse("contact points are not tracked", "track_contact_points", "true, and filter_body_names")
        return self.points

    @property
    def friction_forces_w(self) -> torch.Tensor:
        """Present friction force on each sensed body from each filtered body, (N, B, M, 3), newtons."""
        if self.friction is None:
            self._refuse("friction is not tracked", "track_friction_forces", "true, and filter_body_names")
        return self.friction

    @property
    def pos_w(self) -> torch.Tensor:
        """Positions of the sensed bodies' frames, m, (N, B, 3)."""
        robot, ids = self._posed()
        return robot.data.body_pos_w[:, ids]

    @property
    def quat_w(self) -> torch.Tensor:
        """Orientations of the sensed bodies' frames (w, x, y, z), (N, B, 4)."""
        robot, ids = self._posed()
        return robot.data.body_quat_w[:, ids]

    def _posed(self) -> tuple[Robot, list[int]]:
        if self.posed is None:
            self._refuse("poses are not tracked", "track_pose", "true, for a term that reads poses")
        return self.posed

    def _refuse(self, message: str, name: str, expected: str) -> NoReturn:
        raise ConfigError(message, key=f"{self._key}.{name}", expected=expected)

    def reset(self, ids: torch.Tensor) -> None:
        """Set the contact forces, contact times and air times of the environments ``ids`` to zero."""
        self.set_forces([force.index_fill(0, ids, 0.0) for force in self.forces])
        for name in ("filtered", "points", "friction"):
            if (value := getattr(self, name)) is not None:
                setattr(self, name, value.index_fill(0, ids, torch.nan if name == "points" else 0.0))
        if self._track_air_time:
            for value in self.times.values():
                value.index_fill_(0, ids, 0.0)


class ContactSensor(SensorBase):
    """Sum of the normal contact forces on each sensed body in the last physics step, in world axes.

    Args:
        body_names: expressions of the sensed bodies.
        history_length: physics steps in the history, newest first.
        track_air_time: whether to track contact and air times.
        force_threshold: force above which a body is in contact, N.
        max_contacts: maximum number of contacts of one body that are summed.
        filter_body_names: expressions of bodies, or ``ground``, whose forces are also reported separately; null: none.
        track_pose: whether the data has the bodies' poses.
        track_contact_points: whether the data has the mean position of the contacts with each filtered body.
        track_friction_forces: whether the data has the friction from each filtered body.
    """

    data: ContactSensorData
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
        self._fields_of_pairs = tuple(_SIZES) if any(self._tracked.values()) else _NORMAL
        self._expressions = body_names
        self._history_length = max(1, history_length)
        self.track_air_time = track_air_time
        self.force_threshold = force_threshold
        self._slots = max_contacts

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        super().add_to(spec, name, robot)
        _, self.body_names = robot.find_bodies(self._expressions, key=f"{self.key}.body_names")
        numbers = len(self.body_names) * self._slots * _WIDTH
        require_memory(8 * numbers, f"{self.key}.max_contacts", f"{numbers:,} readings of contacts")
        self._robot, key = robot, f"{self.key}.filter_body_names"
        self.filter_names: list[str] = []
        if self._filters:
            _, self.filter_names = match_names(self._filters, [GROUND, *robot.body_names], key=key, what="body")
        for option, is_tracked in self._tracked.items():
            if is_tracked and not self._filters:
                message = "needs the bodies whose contacts are reported separately"
                expected = f"false, or bodies or ground in {self.key}.filter_body_names"
                raise ConfigError(message, key=f"{self.key}.{option}", expected=expected)
        for body in self.body_names:
            self._sense(spec, body, _NORMAL, {})
        for body, other in product(self.body_names, self.filter_names):
            to = {"reftype": mujoco.mjtObj.mjOBJ_BODY, "refname": "world" if other == GROUND else other}
            self._sense(spec, body, self._fields_of_pairs, to, f"/{other}")

    def _sense(
        self, spec: mujoco.MjSpec, body: str, fields: tuple[str, ...], ref: dict[str, object], suffix: str = ""
    ) -> None:
        flags = sum(1 << int(getattr(mujoco.mjtConDataField, f"mjCONDATA_{name.upper()}")) for name in fields)
        sensed = {"type": mujoco.mjtSensor.mjSENS_CONTACT, "objtype": mujoco.mjtObj.mjOBJ_BODY, "objname": body}
        spec.add_sensor(name=f"{self.name}/{body}{suffix}", intprm=[flags, 0, self._slots], **sensed, **ref)

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        n, bodies, device = sim.num_envs, len(self.body_names), sim.device
        numbers = 3 * n * bodies * self._history_length
        require_memory(4 * numbers, f"{self.key}.history_length", f"{numbers:,} numbers of past forces")
        start = int(sim.model.sensor(f"{self.name}/{self.body_names[0]}").adr[0])
        end = start + bodies * self._slots * _WIDTH
        self._readings = sim.view("sensordata")[:, start:end].view(n, bodies, self._slots, _WIDTH)
        self._pressures, self._normals = self._readings[..., 1].unsqueeze(2), self._readings[..., 4:7]
        self._counts = self._readings[:, :, 0, 0]
        data = ContactSensorData(self.key, n, bodies, self._history_length, self.track_air_time, device)
        self.data = self.child("data", data)
        if self.filter_names:
            sizes, others = [_SIZES[name] for name in self._fields_of_pairs], len(self.filter_names)
            form = n, bodies * others, self._slots, sum(sizes)
            readings = sim.view("sensordata")[:, end : end + form[1] * form[2] * form[3]].view(form)
            # ``_pairs`` has each field of the contacts of all pairs of bodies, (N, B * M, contacts, size).
            self._pairs = dict(zip(self._fields_of_pairs, readings.split(sizes, dim=-1), strict=True))
            data.filtered = torch.zeros(n, self._history_length, bodies, others, 3, device=device)
            if self._tracked["track_contact_points"]:
                data.points = torch.full_like(data.filtered[:, 0], torch.nan)
            if self._tracked["track_friction_forces"]:
                data.friction = torch.zeros_like(data.filtered[:, 0])
        if self._track_pose:
            data.posed = self._robot, [self._robot.body_names.index(body) for body in self.body_names]
        self._largest_norm = self.buffer("_largest_norm", None, saved=False)
        self._found = self.buffer("_found", torch.zeros(n, bodies, dtype=sim.dtype, device=device))

    def max_force_norm(self) -> torch.Tensor:
        """Return the largest contact force of each sensed body over the force history, (N, B), in newtons."""
        if self._largest_norm is None:
            norms = (torch.linalg.vector_norm(force, dim=-1) for force in self.data.forces)
            self._largest_norm = functools.reduce(torch.maximum, norms)
        return self._largest_norm

    def compute_first_contact(self, dt: float) -> torch.Tensor:
        """Return a mask (N, B) of the sensed bodies that touched down within the last ``dt`` seconds."""
        time = self.data.current_contact_time
        return (time > 0.0) & (time < dt * (1 + ROUNDING))

    def compute_first_air(self, dt: float) -> torch.Tensor:
        """Return a mask (N, B) of the sensed bodies that left the ground within the last ``dt`` seconds."""
        time = self.data.current_air_time
        return (time > 0.0) & (time < dt * (1 + ROUNDING))

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        # Negate the sum, because contact forces push the sensed body, but contact normals point away from the body.
        past = self.data.forces
        forces = [summed(self._pressures, self._normals).neg_().float(), *past[:-1]]
        if due is not None:
            forces = [torch.where(due.view(-1, 1, 1), now, before) for now, before in zip(forces, past, strict=True)]
        self.data.set_forces(forces)
        torch.maximum(self._found, self._counts, out=self._found)
        self._largest_norm = None
        if self.filter_names:
            self._measure_pairs(due)
        if not self.track_air_time:
            return
        elapsed = elapsed if isinstance(elapsed, float) else elapsed.unsqueeze(1)
        contact = torch.linalg.vector_norm(self.data.net_forces_w, dim=-1) > self.force_threshold
        for mode, active in (("contact", contact), ("air", ~contact)):
            # Measure the time in contact or in the air; at the end of each contact or flight, store its duration.
            current, last = self.data.times[f"current_{mode}_time"], self.data.times[f"last_{mode}_time"]
            ended = ~active & (current > 0.0)
            lasted, counted = torch.where(ended, current + elapsed, last), torch.where(active, current + elapsed, 0.0)
            if due is not None:
                rows = due.unsqueeze(1)
                lasted, counted = torch.where(rows, lasted, last), torch.where(rows, counted, current)
            last.copy_(lasted)
            current.copy_(counted)

    def _measure_pairs(self, due: torch.Tensor | None) -> None:
        parts, data, form = self._pairs, self.data, (-1, len(self.body_names), len(self.filter_names), 3)
        force = summed(parts["force"][..., 0].unsqueeze(2), parts["normal"]).neg_().float().view(form)
        found = {"filtered": torch.cat((force.unsqueeze(1), data.force_matrix_w_history[:, :-1]), dim=1)}
        if self._tracked["track_contact_points"]:  # Unused slots of contacts contain zeros.
            points = parts["pos"].sum(dim=2) / (parts["found"] > 0.0).sum(dim=2)
            found["points"] = points.float().view(form)
        if self._tracked["track_friction_forces"]:
            tangent, across = parts["tangent"], torch.cross(parts["normal"], parts["tangent"], dim=-1)
            _, along, aside = parts["force"].split(1, dim=-1)
            found["friction"] = (along * tangent + aside * across).sum(dim=2).neg_().float().view(form)
        for name, value in found.items():
            if due is not None:
                value = torch.where(due.view(-1, *[1] * (value.ndim - 1)), value, getattr(data, name))
            setattr(data, name, value)

    def reset(self, ids: torch.Tensor) -> None:
        super().reset(ids)
        self.data.reset(ids)
        self._found.index_fill_(0, ids, 0.0)
        self._largest_norm = None

    @property
    def measures_at_reset(self) -> bool:
        return type(self).refresh is not ContactSensor.refresh

    def refresh(self, env_ids: torch.Tensor) -> None:
        self._is_new.index_fill_(0, env_ids, False)  # After a reset, contact forces are unknown until a physics step.

    def diagnostics(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return ``overflow``: the share of ``env_ids`` with more contacts on one body than the sensor sums."""
        overflowed = (self._found.index_select(0, env_ids) > self._slots).any(dim=1)
        return {"overflow": overflowed.mean(dtype=torch.float32)}

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self.data.set_forces(self.data.forces)
        self._largest_norm = None
