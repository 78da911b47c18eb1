"""Provide Isaac Lab's module paths, so that a term written for Isaac Lab needs only changed import lines.

For example, the line ``from isaaclab.managers import SceneEntityCfg`` becomes ``from wheelleg_exp.isaaclab.managers
import SceneEntityCfg``. ``docs/isaaclab.md`` describes the differences.

Only the modules ``managers`` and ``utils`` have source files. All other modules, such as ``envs``, only give Isaac
Lab's names to existing classes. The import of ``wheelleg_exp.isaaclab`` creates these modules from ``_MODULES``.
"""

from __future__ import annotations

import functools
import inspect
import sys
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.isaaclab_attributes import Simulation
from wheelleg_exp.isaaclab import managers
from wheelleg_exp.sim import actuators, sensors
from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.robot import Robot
from wheelleg_exp.sim.scene import Scene
from wheelleg_exp.sim.terrain import TerrainBase

_TERMS = ("actions", "commands", "curriculums", "events", "observations", "rewards", "terminations")
_MODULES_OF_MANAGERS = ("action_manager", "command_manager", "manager_base", "manager_term_cfg", "scene_entity_cfg")


def _public(module: ModuleType) -> dict[str, Any]:
    own = f"{module.__name__}."
    names = {n: v for n, v in vars(module).items() if not n.startswith("_") and not isinstance(v, ModuleType)}
    return {n: v for n, v in names.items() if f"{getattr(v, '__module__', module.__name__)}.".startswith(own)}


def _with_isaac_labs_parameters(stock: Any) -> Any:
    """Let terms call a stock event as in Isaac Lab: without ``generator``, and as a function if it is a class here.

    The event draws from torch's global generator, which is the random stream of the calling term.
    """
    if not callable(stock) or "generator" not in inspect.signature(stock).parameters:
        return stock
    is_class = inspect.isclass(stock)
    if is_class and stock.__name__.startswith("randomize_"):  # a class in Isaac Lab, too
        return stock
    names = [name for name in inspect.signature(stock).parameters if name not in ("env", "env_ids", "generator")]

    @functools.wraps(stock, updated=() if is_class else ("__dict__",))
    def event(env: Any, env_ids: torch.Tensor | None, *values: Any, **settings: Any) -> None:
        settings |= dict(zip(names[: len(values)], values, strict=True))
        if "generator" not in settings:
            on_gpu = env.device.type == "cuda"
            generator = torch.cuda.default_generators[env.device.index or 0] if on_gpu else torch.default_generator
            settings["generator"] = generator
        if is_class:
            stock(env, **settings)(env, env_ids)
        else:
            stock(env, env_ids, **settings)

    return event


_ROBOT = {"Articulation": Robot, "ArticulationData": ArticulationData}
_BODY = {"RigidObject": Robot, "RigidObjectData": ArticulationData}
_TERMS_BY_KIND = {kind: _public(import_module(f"wheelleg_exp.mdp.{kind}")) for kind in _TERMS}
_EVENTS = _TERMS_BY_KIND["events"]
_EVENTS.update({name: _with_isaac_labs_parameters(event) for name, event in _EVENTS.items()})
_MANAGERS = {name: value for name, value in vars(managers).items() if not name.startswith("_")}
# Each entry of ``_MODULES`` defines a module: path, docstring, and members. A package precedes its modules.
_MODULES: dict[str, tuple[str, dict[str, Any]]] = {
    "actuators": ("The actuator models.", _public(actuators)),
    "assets": ("The robot.", {**_ROBOT, **_BODY, "AssetBase": Robot, "RigidObjectCollection": Robot}),
    "assets.articulation": ("The robot.", _ROBOT),
    "assets.rigid_object": ("The robot.", _BODY),
    "envs": ("The environment.", dict.fromkeys(("ManagerBasedEnv", "ManagerBasedRLEnv"), ManagerBasedRLEnv)),
    "envs.mdp": ("The stock terms.", {name: term for terms in _TERMS_BY_KIND.values() for name, term in terms.items()}),
    **{f"envs.mdp.{kind}": (f"The stock {kind}.", terms) for kind, terms in _TERMS_BY_KIND.items()},
    **{f"managers.{name}": ("Terms and managers.", _MANAGERS) for name in _MODULES_OF_MANAGERS},
    "scene": ("The scene.", {"InteractiveScene": Scene}),
    "sensors": ("The sensors of the scene.", {**_public(sensors), "TiledCamera": sensors.Camera}),
    "sim": ("The simulation, for annotations.", {"SimulationContext": Simulation}),
    "terrains": ("The ground.", {"TerrainImporter": TerrainBase}),
}
for _path, (_doc, _members) in _MODULES.items():
    # Create each ``isaaclab`` module of ``_MODULES``, and make the module importable by its dotted path.
    _module = ModuleType(f"{__name__}.{_path}", _doc)
    _module.__spec__ = ModuleSpec(_module.__name__, None, is_package=True)
    _module.__path__ = []
    vars(_module).update(_members)
    sys.modules[_module.__name__] = _module
    _parent, _, _name = _module.__name__.rpartition(".")
    setattr(sys.modules[_parent], _name, _module)
