"""Net normal contact forces on bodies, sampled after each physics step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.sim.simulation import Simulation
from wheelleg_exp.sim.state import Kept

_FOUND, _FORCE, _NORMAL = (
    1 << int(getattr(mujoco.mjtConDataField, name))
    for name in ("mjCONDATA_FOUND", "mjCONDATA_FORCE", "mjCONDATA_NORMAL")
)
_WIDTH = 7  # found 1, force 3 (contact frame, normal first), normal 3 (world)


class ContactSensor(Kept):
    """Sum of the normal contact forces on each body, world axes, over the last physics step; friction excluded.

    Args:
        body_names: expressions of the sensed bodies.
        history_length: physics steps kept, newest first.
        track_air_time: whether to time contact and flight.
        force_threshold: force above which a body is in contact, N.
        max_contacts: most contacts of one body that are summed.
    """

    def __init__(
        self,
        body_names: str | Sequence[str],
        history_length: int,
        track_air_time: bool,
        force_threshold: float,
        max_contacts: int,
    ) -> None:
        for name, value, least in (
            ("history_length", history_length, 0),
            ("force_threshold", force_threshold, 0.0),
            ("max_contacts", max_contacts, 1),
        ):
            if value < least:
                raise ConfigError(f"is {value}", key=name, expected=f"at least {least}")
        self._expressions = body_names
        self._history_length = max(1, history_length)
        self.track_air_time = track_air_time
        self.force_threshold = force_threshold
        self._slots = max_contacts

    def add_to(self, spec: mujoco.MjSpec, name: str, bodies: Sequence[str]) -> None:
        """Find the sensed bodies and add one MuJoCo contact sensor a body."""
        key = f"env.scene.sensors.{name}.body_names"
        self.name = name
        _, self.body_names = match_names(self._expressions, bodies, key=key, what="body")
        for body in self.body_names:
            spec.add_sensor(
                name=f"{name}/{body}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_BODY,
                objname=body,
                intprm=[_FOUND | _FORCE | _NORMAL, 0, self._slots],
            )

    def connect(self, sim: Simulation) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled."""
        n, bodies = sim.num_envs, len(self.body_names)
        self._dt = float(sim.model.opt.timestep)
        start = int(sim.model.sensor(f"{self.name}/{self.body_names[0]}").adr[0])
        width = bodies * self._slots * _WIDTH
        self._data = sim.view("sensordata")[:, start : start + width].view(n, bodies, self._slots, _WIDTH)
        self._pressures, self._normals = self._data[..., 1].unsqueeze(2), self._data[..., 4:7]
        self.net_forces_w_history = torch.zeros(n, self._history_length, bodies, 3)
        self._norms: torch.Tensor | None = None
        self._found = torch.zeros(n, bodies, dtype=torch.float64)
        times = ("current_air_time", "last_air_time", "current_contact_time", "last_contact_time")
        self._times = {name: torch.zeros(n, bodies) for name in times}

    @property
    def net_forces_w(self) -> torch.Tensor:
        """Net normal force of the last physics step, N, (N, B, 3)."""
        return self.net_forces_w_history[:, 0]

    @property
    def current_air_time(self) -> torch.Tensor:
        """Time since the body left the ground, s, 0 in contact, (N, B)."""
        return self._times["current_air_time"]

    @property
    def last_air_time(self) -> torch.Tensor:
        """Duration of the last flight, s, (N, B)."""
        return self._times["last_air_time"]

    @property
    def current_contact_time(self) -> torch.Tensor:
        """Time since the body touched down, s, 0 in the air, (N, B)."""
        return self._times["current_contact_time"]

    @property
    def last_contact_time(self) -> torch.Tensor:
        """Duration of the last contact, s, (N, B)."""
        return self._times["last_contact_time"]

    def max_force_norm(self) -> torch.Tensor:
        """Largest norm over the history, N, (N, B)."""
        if self._norms is None:
            self._norms = torch.linalg.vector_norm(self.net_forces_w_history, dim=-1).amax(dim=1)
        return self._norms

    def find_bodies(
        self, expressions: str | list[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the sensed bodies that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def compute_first_contact(self, dt: float) -> torch.Tensor:
        """Return which bodies (N, B) touched down within the last ``dt`` seconds."""
        self._require_times()
        time = self.current_contact_time
        return (time > 0.0) & (time < dt + 1e-8)

    def compute_first_air(self, dt: float) -> torch.Tensor:
        """Return which bodies (N, B) left the ground within the last ``dt`` seconds."""
        self._require_times()
        time = self.current_air_time
        return (time > 0.0) & (time < dt + 1e-8)

    def update(self) -> None:
        """Sample the forces of the physics step that has just run."""
        # The normal points away from the sensed body, and force[0] >= 0 pushes the bodies apart.
        torch.maximum(self._found, self._data[:, :, 0, 0], out=self._found)
        force = torch.matmul(self._pressures, self._normals).transpose(1, 2).neg_().float()
        self.net_forces_w_history = torch.cat((force, self.net_forces_w_history[:, :-1]), dim=1)
        self._norms = None
        if self.track_air_time:
            self._update_times()

    def reset(self, ids: torch.Tensor) -> None:
        """Forget forces and times of ``ids``."""
        self.net_forces_w_history = self.net_forces_w_history.index_fill(0, ids, 0.0)
        self._found[ids] = 0.0
        self._norms = None
        for value in self._times.values():
            value[ids] = 0.0

    def overflowed(self, ids: torch.Tensor) -> torch.Tensor:
        """Return which of ``ids`` had more contacts on one body than ``max_contacts`` since their reset, (n,) bool."""
        return (self._found[ids] > self._slots).any(dim=1)

    def state_dict(self) -> dict[str, Any]:
        """Return the force history and the times."""
        return {
            "history": self.net_forces_w_history.clone(),
            "found": self._found.clone(),
            **{k: v.clone() for k, v in self._times.items()},
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.net_forces_w_history = saved["history"].clone()
        self._found.copy_(saved["found"])
        for name, value in self._times.items():
            value.copy_(saved[name])
        self._norms = None

    def _require_times(self) -> None:
        if not self.track_air_time:
            raise ConfigError(
                "contact and flight are not timed",
                key=f"env.scene.sensors.{self.name}.track_air_time",
                expected="true, for a term that asks for first contacts",
            )

    def _update_times(self) -> None:
        contact = torch.linalg.vector_norm(self.net_forces_w, dim=-1) > self.force_threshold
        self._advance("contact", contact)
        self._advance("air", ~contact)

    def _advance(self, mode: str, active: torch.Tensor) -> None:
        """Count the time in a mode; where it has just ended, keep its duration."""
        current, last = self._times[f"current_{mode}_time"], self._times[f"last_{mode}_time"]
        ended = ~active & (current > 0.0)
        last.copy_(torch.where(ended, current + self._dt, last))
        current.copy_(torch.where(active, current + self._dt, 0.0))
