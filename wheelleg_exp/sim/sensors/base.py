"""What every sensor has: a place in the model, a rhythm, a stream, a state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import torch

from wheelleg_exp.constraints import NonNegative
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.names import match_names
from wheelleg_exp.state import Kept
from wheelleg_exp.terms.failures import code_place, dotted_name

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
