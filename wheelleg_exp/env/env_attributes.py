"""Save attributes that manager terms add to the environment; raise ConfigError for state that cannot be saved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.managers import Env
from wheelleg_exp.state import Memory, Outside, Stateful, saved_values
from wheelleg_exp.state.object_graph import PLAIN
from wheelleg_exp.state.saved_values import NOTHING, Unsaveable, snapshot
from wheelleg_exp.state.stateful import refusal

# Manager terms do not set these attributes of the environment; the environment or its caller sets them.
_OWN = (
    "seed",
    "common_step_counter",
    "extras",
    "keep_final_obs",
    "autoreset",
    "observers",
    "cfg",
    "options",
    "graph_capture",
)


class EnvAttributes:
    """Saves and restores the attributes that manager terms add to the environment.

    Raise ConfigError if a manager term holds state that cannot be saved, or has changed the compiled MuJoCo model.
    """

    def __init__(self, env: Env, managers: Mapping[str, Any], cfg: Mapping[str, Any]) -> None:
        terms = [term for manager in managers.values() for term in getattr(manager, "bound_terms", [])]
        robot, owners = env.scene.robot, _owners(env, terms)
        watched: dict[str, Any] = {"env": env, "env.scene": env.scene, "env.scene.terrain": env.scene.terrain}
        watched |= {"env.robot": robot, "env.robot.data": robot.data}
        watched |= {f"env.scene.sensors.{name}": sensor for name, sensor in env.scene.sensors.items()}
        watched |= {f"env.{name}": manager for name, manager in managers.items() if name != "scene"}
        env.scene.require_compiled_model()
        self._env = env
        parts = owners | {k: v for k, v in watched.items() if k.startswith(("env.scene.sensors.", "env.scene.terrain"))}
        code = {term.path: term.func for term in terms} | {key: type(value) for key, value in parts.items()}
        owned = {k: v for k, v in watched.items() if k != "env"} | {term.path: term for term in terms}
        owned |= {"env.scene.sim": env.scene.sim, "env.streams": env.streams}
        self._outside = Outside(code, owned, cfg)
        self._memory = Memory(owners, lambda: _tensors(watched) | {"the state": env.scene.sim.state})
        self._names = {*vars(env), "_attributes"}
        self._plain = {name: item for name, item in vars(env).items() if _is_plain(name, item)}

    def save(self) -> dict[str, Any]:
        """Return the attributes of the environment that terms have added or changed.

        Raise ConfigError if a term stores state outside of its own attributes and the environment's attributes.
        """
        self._env.scene.require_compiled_model()
        self._outside.require_unchanged()
        self._memory.require_apart()
        found = {}
        for name, item in vars(self._env).items():
            is_changed = _is_plain(name, item) and not saved_values.same(item, self._plain.get(name, NOTHING))
            if name in self._names and not is_changed:
                continue
            try:
                seen = snapshot(item, name)
                if not isinstance(seen, saved_values.Reference):
                    found[name] = saved_values.checkpoint_value(seen, NOTHING, name)
            except (Unsaveable, RecursionError) as error:
                raise refusal(self._env, error, "env") from error
        return found

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Restore the attributes that ``save`` returned, and delete all other attributes that terms added."""
        for name in vars(self._env).keys() - self._names - saved.keys():
            delattr(self._env, name)
        for name, item in {**self._plain, **saved}.items():
            setattr(self._env, name, saved_values.restored_value(item, vars(self._env).get(name)))


def _is_plain(name: str, item: Any) -> bool:
    return type(item) in PLAIN and name not in _OWN


def _owners(env: Env, terms: list[Any]) -> dict[str, Any]:
    """Return the terms, actuators, and observation modifiers whose attributes a checkpoint contains, by config key."""
    found: dict[str, Any] = {term.path: term.stateful for term in terms if term.stateful is not None}
    found |= {f"env.robot.actuators.{name}": actuator for name, actuator in env.scene.robot.actuators.items()}
    manager = env.observation_manager
    for group in manager.active_terms:
        for term in manager.terms(group).values():
            found |= {f"{term.term.path}.{name}": part for name, part in term.parts().items()}
    return {key: value for key, value in found.items() if isinstance(value, Stateful) or hasattr(value, "__dict__")}


def _tensors(watched: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    items = ((f"{owner}.{name}", item) for owner, value in watched.items() for name, item in vars(value).items())
    return {name: item for name, item in items if isinstance(item, torch.Tensor)}
