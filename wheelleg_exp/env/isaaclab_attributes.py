"""Attributes of Isaac Lab's environments: the buffers, the config by attributes, and ``sim``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Self, cast

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.sim.class_members import alias_of, declare_unsupported
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_binding import FIELD_TYPES, TARGET

if TYPE_CHECKING:
    from wheelleg_exp.managers import Env


_SPACES = "wheelleg_exp.gym has the Gymnasium faces; widths are in action_manager and observation_manager"
# Map keys of Isaac Lab's environment config to their paths in this project's config section ``env``.
_OTHER_PATHS = {"scene.num_envs": "num_envs", "sim.render_interval": "decimation"}


class NoSuchKey(ConfigError, AttributeError):
    """The error for a missing key in an environment's config, or for an attempt to change the config."""


class Cfg(Mapping[str, Any]):
    """A read-only section of the composed config, with access by attribute and by key.

    The config section of a term has ``func``, the path of the term's function, and ``params``, the term's parameters.
    ``root`` is the complete config section ``env``.
    """

    def __init__(self, section: Mapping[str, object], path: str = "env", root: object = None) -> None:
        vars(self).update(_section=section, _path=path, _root=section if root is None else root)

    def __getitem__(self, key: str) -> Any:
        return self._section[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._section)

    def __len__(self) -> int:
        return len(self._section)

    def __getattr__(self, name: str) -> Any:
        section, path = self._section, self._path
        if name in section:
            value = section[name]
            return Cfg(value, f"{path}.{name}", self._root) if isinstance(value, Mapping) else value
        if TARGET in section and name == "params":
            parameters = {key: value for key, value in section.items() if key != TARGET and key not in FIELD_TYPES}
            return Cfg(parameters, path, self._root)
        if TARGET in section and name in ("func", "class_type"):
            return section[TARGET]
        elsewhere = _OTHER_PATHS.get(f"{path}.{name}".removeprefix("env."))
        if elsewhere is not None:
            return self._root[elsewhere]
        message, expected = "the environment's config does not contain this key", "one of " + ", ".join(section)
        raise NoSuchKey(message, key=f"{path}.{name}", expected=expected, nearest=nearest_name(name, section))

    def __setattr__(self, name: str, value: object) -> None:
        expected = "a change of the term: env.reward_manager.get_term_cfg(name).weight, ... .params"
        raise NoSuchKey("the environment's config is read-only", key=f"{self._path}.{name}", expected=expected)

    def __repr__(self) -> str:
        return f"Cfg({self._section!r})"


@declare_unsupported(
    {
        "physics_sim_view": "there is no PhysX; env.scene.sim is the engine",
        "render": "pictures are drawn by wheelleg play and recordings",
        "stage": "there is no USD stage; env.scene.spec is the model's",
    }
)
class Simulation:
    """The object ``env.sim`` for manager terms that were written for Isaac Lab and read its attributes."""

    def __init__(self, env: Env) -> None:
        self._env = env

    cfg = alias_of("_env.cfg.sim", "The ``env.sim`` section of the config.")
    device = alias_of("_env.device", "The device of all tensors.")

    def get_physics_dt(self) -> float:
        """Return the physics step, s."""
        return self._env.physics_dt

    def has_gui(self) -> bool:
        """Return False, because the simulation never opens a window."""
        return False

    def is_playing(self) -> bool:
        """Return True (the physics simulation is running), because the simulation cannot be paused."""
        return True


@declare_unsupported(
    dict.fromkeys(("single_action_space", "single_observation_space", "action_space", "observation_space"), _SPACES)
    | {"viewport_camera_controller": "there is no window", "render": "wheelleg play and recordings draw pictures"}
)
class IsaacLabAttributes(Stateful):
    """Attributes of Isaac Lab's environments, computed from the managers."""

    if TYPE_CHECKING:
        decimation: int
        common_step_counter: int

    @property
    def unwrapped(self) -> Self:
        """The environment itself."""
        return self

    @property
    def sim(self) -> Simulation:
        """The simulation object that manager terms written for Isaac Lab use. The engine itself is ``scene.sim``."""
        return Simulation(cast("Env", self))

    num_actions = alias_of("action_manager.total_action_dim", "Number of the actions of an environment.")
    obs_buf = alias_of("observation_manager.obs_buf", "The last observations by group.")
    reset_buf = alias_of(
        "termination_manager.dones", "Mask (N,) of the environments whose episode ended in the last control step."
    )
    reset_terminated = alias_of(
        "termination_manager.terminated", "Mask (N,) of the environments whose episode failed in the last control step."
    )
    reset_time_outs = alias_of(
        "termination_manager.time_outs",
        "Mask (N,) of the environments whose episode reached its time limit in the last control step.",
    )

    @property
    def _sim_step_counter(self) -> int:
        return self.common_step_counter * self.decimation
