"""Base classes of sensors: ``SensorBase`` measures after physics steps, ``LazySensor`` when code reads ``data``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import torch

from wheelleg_exp.constraints import Broken, NonNegative
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.class_members import TensorProperty
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import fill_rows, ids_where
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_errors import blamed, code_place, dotted_name

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot
    from wheelleg_exp.sim.terrain import TerrainBase

ROUNDING = 1e-4  # Largest relative error of a time that is a float32 sum of up to ten thousand physics steps.


class SensorBase(Stateful):
    """A sensor of the scene: one YAML node under ``env.scene.sensors``, from this package or user-defined.

    A subclass adds elements to the MuJoCo spec in ``add_to``, and updates ``data``, whose attributes have Isaac Lab's
    names and whose tensors (N, ...) are on the engine's device, in ``measure``. ``connect`` must declare everything
    that later measurements depend on (see ``Stateful``). The scene sets ``name`` and ``terrain`` before ``add_to``.

    Args:
        update_period: time between two measurements, s; 0 measures after every physics step.
    """

    name: str
    terrain: TerrainBase
    data: Any
    body_names: list[str]

    def __init__(self, update_period: NonNegative = 0.0) -> None:
        self.update_period = update_period

    @property
    def key(self) -> str:
        """The sensor's config key."""
        return f"env.scene.sensors.{self.name}"

    @property
    def num_bodies(self) -> int:
        """Number of sensed bodies."""
        return len(self.body_names)

    @property
    def cfg(self) -> SensorBase:
        """Return the sensor itself, because Isaac Lab's terms read a sensor's settings from ``sensor.cfg``."""
        return self

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        """Add the sensor's elements to the uncompiled MuJoCo spec; raise ConfigError if a named body does not exist."""
        del spec, robot
        self.name, self.body_names = name, []

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Connect to the running simulations, once; call ``stream`` only if the sensor needs a random generator."""
        del stream
        self._sim = sim
        self._dt = float(sim.model.opt.timestep)
        elapsed = torch.full((sim.num_envs,), self.update_period, device=sim.device)
        self._elapsed = self.buffer("_elapsed", elapsed, saved=self.update_period > 0.0)
        is_new = torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device)
        self._is_new = self.buffer("_is_new", is_new, saved=False)

    def update(self) -> None:
        """After a physics step, measure in environments whose update period has passed or whose episode is new."""
        if self.update_period == 0.0:
            self.measure(None, self._dt)
            return
        self._elapsed += self._dt
        due = self._elapsed >= self.update_period * (1 - ROUNDING)
        self.measure(due, self._elapsed)
        self._elapsed.masked_fill_(due, 0.0)

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        """Update the measurements of ``due`` (N,), a mask or None for all, ``elapsed`` seconds after the last ones."""
        raise NotImplementedError("a sensor must define the method 'measure(due, elapsed)'")

    def reset(self, env_ids: torch.Tensor) -> None:
        """Start a new episode of the sensor in the environments ``env_ids``, before reset events run."""
        fill_rows(self._is_new, env_ids, True)
        if self.update_period > 0.0:
            self._elapsed.index_fill_(0, env_ids, self.update_period)

    @property
    def measures_at_reset(self) -> bool:
        """Whether the sensor's method ``refresh`` measures again after each reset."""
        return True

    def refresh(self, env_ids: torch.Tensor) -> None:
        """After a reset, update the measurements of ``env_ids``, so that the first observation shows the new state."""
        new = env_ids[self._is_new[env_ids]]
        if len(new):
            due = torch.zeros_like(self._is_new).index_fill_(0, new, True)
            self.measure(due, self._elapsed if self.update_period > 0.0 else self._dt)
            self._is_new.index_fill_(0, new, False)

    def diagnostics(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return log entries, by name, such as the share of ending episodes that exceeded a limit of the sensor."""
        del env_ids
        return {}

    def find_bodies(
        self, expressions: str | Sequence[str], preserve_order: bool = False, *, key: str = "body_names"
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of matching sensed bodies; raise ConfigError if an expression matches no body."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self._is_new.fill_(False)


def require_base_called(sensor: SensorBase, attribute: str, call: str) -> None:
    """Raise ConfigError if an overriding method does not call the base method, which sets ``attribute``."""
    if not hasattr(sensor, attribute):
        method = call.partition("(")[0]
        message = f"'{dotted_name(sensor)}.{method}' does not call the base class's method"
        place = code_place(getattr(sensor, method))
        raise ConfigError(message, key=sensor.key, where=place, expected=f"super().{call} in it")


class LazySensor(SensorBase):
    """A sensor whose method ``sense`` takes a measurement when code reads ``data``, at most once per physics state.

    With an ``update_period``, it measures at resets and once per period, even without reads.

    Args:
        update_period: time between two measurements, s; 0 measures the present state at every read.
    """

    _data: Any

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Update the measurements of the environments ``ids``; a slice means all environments."""
        raise NotImplementedError("a lazy sensor must define the method 'sense(ids)'")

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        super().connect(sim, stream)
        self._outdated: torch.Tensor | slice | None = self.number("_outdated", slice(None), saved=False)

    @property
    def data(self) -> Any:
        """The measurement, read-only."""
        if self._outdated is not None:
            with blamed(self.key, self, has_worked=True):
                self.sense(self._outdated)
            self._outdated = None
        return self._data

    def update(self) -> None:
        if self.update_period == 0.0:
            self._outdated = slice(None)
        else:
            super().update()

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:  # noqa: ARG002
        self.sense(slice(None) if due is None else ids_where(due))

    def reset(self, env_ids: torch.Tensor) -> None:
        fill_rows(self._elapsed, env_ids, 0.0)
        fill_rows(self._is_new, env_ids, True)

    def refresh(self, env_ids: torch.Tensor) -> None:
        if self.update_period == 0.0:
            if not isinstance(self._outdated, slice):
                seen = env_ids if self._outdated is None else torch.cat((self._outdated, env_ids)).unique()
                self._outdated = seen
        else:
            self._outdated = None
            self.sense(env_ids[self._is_new[env_ids]])
        fill_rows(self._is_new, env_ids, False)

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self._outdated = slice(None) if self.update_period == 0.0 else None


Offset = Mapping[Literal["pos", "rot"], Sequence[float]]
_CameraOffset = Mapping[Literal["pos", "rot", "convention"], Sequence[float] | Literal["world", "ros", "opengl"]]


def offset_fits(offset: Offset | _CameraOffset | None) -> Iterator[Broken]:
    """Check a sensor's ``offset``, which has ``pos`` (x, y, z), m, and ``rot`` (w, x, y, z)."""
    pos, rot = (offset or {}).get("pos", (0, 0, 0)), (offset or {}).get("rot", (1, 0, 0, 0))
    if len(pos) != 3:
        yield Broken("offset.pos", f"{pos!r} is not a position", "3 finite numbers")
    if len(rot) != 4 or not any(rot):
        yield Broken("offset.rot", f"{rot!r} is not an orientation", "4 finite numbers (w, x, y, z), not all zero")


def offset_pose(offset: Offset | None, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the position (3,), m, and the unit quaternion (4,) of an offset."""
    given = offset or {}
    pos = torch.tensor(given.get("pos", (0.0, 0.0, 0.0)), device=device)
    rot = torch.tensor(given.get("rot", (1.0, 0.0, 0.0, 0.0)), device=device)
    return pos, torch.nn.functional.normalize(rot, dim=0)


def _of_body(of_root: str, of_bodies: str, doc: str) -> TensorProperty:
    """Make a property that reads ``robot.data``: ``of_root`` for the root link, ``of_bodies`` for other links."""

    def get(self: Mount) -> torch.Tensor:
        # Reading ``of_root`` is cheaper, because only ``of_bodies`` needs forward kinematics.
        data = self._robot.data
        found: torch.Tensor = getattr(data, of_root) if self.index == 0 else getattr(data, of_bodies)[:, self.index]
        return found

    return TensorProperty(get, doc=doc)


class Mount:
    """The robot's body on which a sensor is mounted; raise ConfigError unless a regular expression matches one body."""

    def __init__(self, expression: str, robot: Robot, key: str) -> None:
        found, names = robot.find_bodies([expression], key=key)
        if len(names) > 1:
            raise ConfigError(f"'{expression}' matches {', '.join(names)}", key=key, expected="one body")
        self.body, self.index, self._robot = names[0], found[0], robot

    pos_w = _of_body("root_pos_w", "body_pos_w", "Position of the body's frame, m, (N, 3).")
    quat_w = _of_body("root_quat_w", "body_quat_w", "Orientation of the body's frame (w, x, y, z), (N, 4).")
    rot_w = _of_body("root_rot_w", "body_rot_w", "Rotation matrix of the body's frame, (N, 3, 3).")
    lin_vel_w = _of_body("root_link_lin_vel_w", "body_link_lin_vel_w", "Velocity of the frame's origin, m/s, (N, 3).")
    ang_vel_w = _of_body("root_ang_vel_w", "body_ang_vel_w", "Angular velocity of the body, rad/s, world axes, (N, 3).")
