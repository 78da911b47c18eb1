"""Base classes of sensors, which measure after each physics step or on the first read, and their mount on a body."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import mujoco
import torch

from wheelleg_exp.constraints import Broken, NonNegative
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import fill_rows, ids_where
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.state import Kept
from wheelleg_exp.terms.term_errors import blamed, code_place, dotted_name

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot
    from wheelleg_exp.sim.terrain import TerrainBase


class SensorBase(Kept):
    """A sensor of the scene: one YAML node under ``env.scene.sensors``, from this package or user-defined.

    A subclass adds its elements to the spec, connects to the running simulations, and measures in ``measure``. Its
    tensors are (N, ...) on the engine's device. ``state_dict`` must contain everything that later steps depend on.

    Args:
        update_period: time between two measurements, s; 0 measures after every physics step.

    Attributes:
        name: the sensor's name in the scene, set before ``add_to``.
        terrain: the scene's ground, set before ``add_to``.
        body_names: names of the sensed bodies.
        data: the measurement, under the names of Isaac Lab's sensor of the same kind.
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
    def cfg(self) -> SensorBase:
        """The sensor itself: its settings are attributes, which terms written for Isaac Lab read from ``cfg``."""
        return self

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        """Add the sensor's elements to the spec, before the scene is compiled.

        Args:
            spec: the scene's spec.
            name: the sensor's name.
            robot: the robot, before compilation.

        Raises:
            ConfigError: an expression of the sensor matches nothing.
        """
        del spec, robot
        self.name, self.body_names = name, []

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled.

        Args:
            sim: the simulations.
            stream: returns the sensor's random stream; a sensor without random numbers does not call it.
        """
        del stream
        self._sim = sim
        self._dt = float(sim.model.opt.timestep)
        self._elapsed = torch.full((sim.num_envs,), self.update_period, device=sim.device)

    def update(self) -> None:
        """Measure, after a physics step, the environments whose update period is over.

        As in Isaac Lab, each environment has its own timer, and the first step of an episode is measured.
        """
        if self.update_period == 0.0:
            self.measure(None, self._dt)
            return
        self._elapsed += self._dt
        due = self._elapsed >= self.update_period - 1e-6
        self.measure(due, self._elapsed)
        self._elapsed.masked_fill_(due, 0.0)

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:
        """Measure.

        Args:
            due: mask (N,) of the environments to measure; None means all. The others keep their measurement.
            elapsed: time since the last measurement, s, (N,) or one number for all.
        """
        raise NotImplementedError("a sensor needs 'measure(due, elapsed)'")

    def reset(self, env_ids: torch.Tensor) -> None:
        """Clear the measurement of ``env_ids``; reset events write their new state later."""
        if self.update_period > 0.0:
            self._elapsed.index_fill_(0, env_ids, self.update_period)

    @property
    def refreshes(self) -> bool:
        """Whether the sensor overrides ``refresh``."""
        return type(self).refresh is not SensorBase.refresh

    def refresh(self, env_ids: torch.Tensor) -> None:
        """Update the measurement of ``env_ids`` after their state was written, before the first observation."""

    def diagnostics(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return log entries, by name, about limits that the sensor could not keep in episodes that end now."""
        del env_ids
        return {}

    def find_bodies(
        self, expressions: str | Sequence[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the sensed bodies that match; ConfigError if an expression matches no body."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that later measurements depend on."""
        return {} if self.update_period == 0.0 else {"elapsed": self._elapsed.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        if self.update_period > 0.0:
            self._elapsed.copy_(saved["elapsed"])


def require_base_called(sensor: SensorBase, attribute: str, call: str) -> None:
    """Raise ConfigError if an overriding method has not called the base class's method, which sets ``attribute``."""
    if not hasattr(sensor, attribute):
        method = call.partition("(")[0]
        message = f"'{dotted_name(sensor)}.{method}' does not call the base class's method"
        place = code_place(getattr(sensor, method))
        raise ConfigError(message, key=sensor.key, where=place, expected=f"super().{call} in it")


class LazySensor(SensorBase):
    """Measures when ``data`` is read, at most once for each state; a subclass writes to ``_data`` in ``sense``.

    With an update period the sensor stores its measurement. Each environment is then measured at its reset and at the
    first physics step after the period, whether or not ``data`` is read. So reading never changes a result.

    Args:
        update_period: time between two measurements, s; 0 measures the present state at every read.
    """

    def __init__(self, update_period: NonNegative = 0.0) -> None:
        super().__init__(update_period)
        self._data: Any = None

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Measure the environments ``ids``; a slice means all."""
        raise NotImplementedError("a lazy sensor needs 'sense(ids)'")

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; a subclass creates its ``_data``."""
        super().connect(sim, stream)
        self._outdated: torch.Tensor | slice | None = slice(None)
        self._is_new = torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device)

    @property
    def data(self) -> Any:
        """The measurement, read-only."""
        if self._outdated is not None:
            with blamed(self.key, self, has_worked=True):  # an error here is the sensor's, not the reading term's
                self.sense(self._outdated)
            self._outdated = None
        return self._data

    def update(self) -> None:
        """Mark the measurement as outdated after a physics step, or measure when the period is over."""
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
        """Mark the written ``env_ids`` as outdated; with an update period, measure those that start an episode."""
        if self.update_period == 0.0:
            if not isinstance(self._outdated, slice):
                seen = env_ids if self._outdated is None else torch.cat((self._outdated, env_ids)).unique()
                self._outdated = seen
        else:
            self._outdated = None
            self.sense(env_ids[self._is_new[env_ids]])
        fill_rows(self._is_new, env_ids, False)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; without an update period the next read measures again."""
        super().load_state_dict(saved)
        self._outdated = slice(None) if self.update_period == 0.0 else None
        self._is_new.fill_(False)


Offset = Mapping[Literal["pos", "rot"], Sequence[float]]


def offset_fits(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Check an ``offset``: ``pos`` (x, y, z), m, and ``rot`` (w, x, y, z)."""
    offset = given["offset"] or {}
    if len(offset.get("pos", (0, 0, 0))) != 3:
        yield Broken("offset.pos", f"{offset['pos']!r} is not a position", "3 finite numbers")
    if len(offset.get("rot", (1, 0, 0, 0))) != 4 or not any(offset.get("rot", (1, 0, 0, 0))):
        yield Broken(
            "offset.rot", f"{offset['rot']!r} is not an orientation", "4 finite numbers (w, x, y, z), not all zero"
        )


def offset_pose(offset: Offset | None, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the position (3,), m, and the unit quaternion (4,) of an offset."""
    given = offset or {}
    pos = torch.tensor(given.get("pos", (0.0, 0.0, 0.0)), device=device)
    rot = torch.tensor(given.get("rot", (1.0, 0.0, 0.0, 0.0)), device=device)
    return pos, torch.nn.functional.normalize(rot, dim=0)


class Mount(Kept):
    """The body of the robot that a sensor is mounted on.

    Args:
        expression: expression of the body.
        robot: the robot, before compilation.
        key: the config key of the expression.

    Raises:
        ConfigError: the expression matches no body, or several bodies.
    """

    def __init__(self, expression: str, robot: Robot, key: str) -> None:
        found, names = robot.find_bodies([expression], key=key)
        if len(names) > 1:
            raise ConfigError(f"'{expression}' matches {', '.join(names)}", key=key, expected="one body")
        self.body, self.index, self._robot = names[0], found[0], robot

    @property
    def pos_w(self) -> torch.Tensor:
        """Position of the body's frame, m, (N, 3)."""
        # The root's pose is part of the state. The pose of any other link makes the engine compute it after each step.
        data = self._robot.data
        return data.root_pos_w if self.index == 0 else data.body_pos_w[:, self.index]

    @property
    def quat_w(self) -> torch.Tensor:
        """Orientation of the body's frame (w, x, y, z), (N, 4)."""
        data = self._robot.data
        return data.root_quat_w if self.index == 0 else data.body_quat_w[:, self.index]

    @property
    def rot_w(self) -> torch.Tensor:
        """Rotation matrix of the body's frame, (N, 3, 3)."""
        data = self._robot.data
        return data.root_rot_w if self.index == 0 else data.body_rot_w[:, self.index]

    @property
    def lin_vel_w(self) -> torch.Tensor:
        """Velocity of the origin of the body's frame, m/s, world axes, (N, 3)."""
        data = self._robot.data
        return data.root_link_lin_vel_w if self.index == 0 else data.body_link_lin_vel_w[:, self.index]

    @property
    def ang_vel_w(self) -> torch.Tensor:
        """Angular velocity of the body, rad/s, world axes, (N, 3)."""
        data = self._robot.data
        return data.root_ang_vel_w if self.index == 0 else data.body_ang_vel_w[:, self.index]
