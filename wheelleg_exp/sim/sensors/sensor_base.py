"""Base classes of sensors: after each physics step, or on the first read; and the mount on a body."""

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
    """A sensor of the scene; one YAML node under ``env.scene.sensors``, from this package or a user's own.

    A subclass adds what it needs to the spec, connects to the running simulations, and measures in ``measure``. Its
    tensors are (N, ...) on the engine's device; what the coming steps depend on goes through ``state_dict``.

    Args:
        update_period: time between two measurements, s; 0 measures after every physics step.

    Attributes:
        name: the sensor's name in the scene, known from before ``add_to`` on.
        terrain: the scene's ground, known from before ``add_to`` on.
        body_names: the bodies that it senses.
        data: what was measured, under Isaac Lab's names where it has a like sensor.
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
        """The sensor itself, whose settings are its attributes, as terms written for Isaac Lab read them."""
        return self

    def add_to(self, spec: mujoco.MjSpec, name: str, robot: Robot) -> None:
        """Take a name, and add to the spec what the sensor needs, before the scene is compiled.

        Args:
            spec: the scene's spec.
            name: the sensor's name.
            robot: the robot, whose names are known and which does not run yet.

        Raises:
            ConfigError: an expression of the sensor's matches nothing.
        """
        del spec, robot
        self.name, self.body_names = name, []

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled.

        Args:
            sim: the simulations.
            stream: returns the sensor's random stream; one that draws nothing does not ask for it.
        """
        del stream
        self._sim = sim
        self._dt = float(sim.model.opt.timestep)
        self._elapsed = torch.full((sim.num_envs,), self.update_period, device=sim.device)

    def update(self) -> None:
        """Take up the physics step that has just run, and measure the environments whose time it is.

        As in Isaac Lab the time runs in each environment by itself: an episode's first step is measured.
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
            due: the environments (N,) bool, None for all; what was measured of others stays.
            elapsed: time since the last measurement, s, (N,) or one for all.
        """
        raise NotImplementedError("a sensor needs 'measure(due, elapsed)'")

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget what was measured of ``env_ids``; their new state is not there yet."""
        if self.update_period > 0.0:
            self._elapsed.index_fill_(0, env_ids, self.update_period)

    @property
    def refreshes(self) -> bool:
        """Whether it has something to do when states were written."""
        return type(self).refresh is not SensorBase.refresh

    def refresh(self, env_ids: torch.Tensor) -> None:
        """Take up the new state of ``env_ids`` after resets, for what the first observation reads."""

    def diagnostics(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return what the log says of limits that the sensor could not keep, by name, over episodes that end now."""
        del env_ids
        return {}

    def find_bodies(
        self, expressions: str | Sequence[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the sensed bodies that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def state_dict(self) -> dict[str, Any]:
        """Return what the coming measurements depend on."""
        return {} if self.update_period == 0.0 else {"elapsed": self._elapsed.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        if self.update_period > 0.0:
            self._elapsed.copy_(saved["elapsed"])


def require_base_called(sensor: SensorBase, attribute: str, call: str) -> None:
    """Raise ConfigError when a sensor's own method has not called the base class's, which sets an attribute."""
    if not hasattr(sensor, attribute):
        method = call.partition("(")[0]
        message = f"'{dotted_name(sensor)}.{method}' does not call the base class's"
        place = code_place(getattr(sensor, method))
        raise ConfigError(message, key=sensor.key, where=place, expected=f"super().{call} in it")


class LazySensor(SensorBase):
    """Measures when ``data`` is read, at most once of each state; a subclass measures in ``sense`` into ``_data``.

    With an update period it holds what it has measured: each environment is measured at its reset, and at the first
    physics step at which the period is over, whether it is read or not; so reading never changes anything.

    Args:
        update_period: time between two measurements, s; 0 shows the present state at every reading.
    """

    def __init__(self, update_period: NonNegative = 0.0) -> None:
        super().__init__(update_period)
        self._data: Any = None

    def sense(self, ids: torch.Tensor | slice) -> None:
        """Measure some environments: their ids, or a slice of all."""
        raise NotImplementedError("a lazy sensor needs 'sense(ids)'")

    def connect(self, sim: Engine, stream: Callable[[], torch.Generator]) -> None:
        """Attach to the running simulations; a subclass makes its ``_data``."""
        super().connect(sim, stream)
        self._outdated: torch.Tensor | slice | None = slice(None)
        self._is_new = torch.ones(sim.num_envs, dtype=torch.bool, device=sim.device)

    @property
    def data(self) -> Any:
        """What was measured; it is not to be written into."""
        if self._outdated is not None:
            with blamed(self.key, self, has_worked=True):  # a term reads, and is not to blame
                self.sense(self._outdated)
            self._outdated = None
        return self._data

    def update(self) -> None:
        """Take up the physics step that has just run."""
        if self.update_period == 0.0:
            self._outdated = slice(None)
        else:
            super().update()

    def measure(self, due: torch.Tensor | None, elapsed: float | torch.Tensor) -> None:  # noqa: ARG002
        """Measure the environments that are due (see ``SensorBase.measure``)."""
        self.sense(slice(None) if due is None else ids_where(due))

    def reset(self, env_ids: torch.Tensor) -> None:
        """Note that ``env_ids`` are to be measured once their new state is there."""
        fill_rows(self._elapsed, env_ids, 0.0)
        fill_rows(self._is_new, env_ids, True)

    def refresh(self, env_ids: torch.Tensor) -> None:
        """Take up the state of ``env_ids`` that has been written; what is held is measured of new episodes alone."""
        if self.update_period == 0.0:
            if not isinstance(self._outdated, slice):
                seen = env_ids if self._outdated is None else torch.cat((self._outdated, env_ids)).unique()
                self._outdated = seen
        else:
            self._outdated = None
            self.sense(env_ids[self._is_new[env_ids]])
        fill_rows(self._is_new, env_ids, False)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned; what is not held is measured anew."""
        super().load_state_dict(saved)
        self._outdated = slice(None) if self.update_period == 0.0 else None
        self._is_new.fill_(False)


Offset = Mapping[Literal["pos", "rot"], Sequence[float]]


def offset_fits(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold an ``offset`` against its form: ``pos`` (x, y, z), m, and ``rot`` (w, x, y, z)."""
    offset = given["offset"] or {}
    if len(offset.get("pos", (0, 0, 0))) != 3:
        yield Broken("offset.pos", f"{offset['pos']!r} is no position", "3 finite numbers")
    if len(offset.get("rot", (1, 0, 0, 0))) != 4 or not any(offset.get("rot", (1, 0, 0, 0))):
        yield Broken(
            "offset.rot", f"{offset['rot']!r} is no orientation", "4 finite numbers (w, x, y, z), not all zero"
        )


def offset_pose(offset: Offset | None, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an offset's position (3,), m, and unit quaternion (4,)."""
    given = offset or {}
    pos = torch.tensor(given.get("pos", (0.0, 0.0, 0.0)), device=device)
    rot = torch.tensor(given.get("rot", (1.0, 0.0, 0.0, 0.0)), device=device)
    return pos, torch.nn.functional.normalize(rot, dim=0)


class Mount(Kept):
    """The body of the robot that a sensor sits on.

    Args:
        expression: names the body.
        robot: the robot, whose names are known.
        key: the config key of the expression.

    Raises:
        ConfigError: it matches no body, or several.
    """

    def __init__(self, expression: str, robot: Robot, key: str) -> None:
        found, names = robot.find_bodies([expression], key=key)
        if len(names) > 1:
            raise ConfigError(f"'{expression}' matches {', '.join(names)}", key=key, expected="one body")
        self.body, self.index, self._robot = names[0], found[0], robot

    @property
    def pos_w(self) -> torch.Tensor:
        """Position of the body's frame, m, (N, 3)."""
        # A free root's pose is state; that of any other link makes MuJoCo compute it behind each step.
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
