"""Provide Isaac Lab's module paths, so that a term written for Isaac Lab needs only changed import lines.

For example, the line ``from isaaclab.managers import SceneEntityCfg`` becomes ``from wheelleg_exp.isaaclab.managers
import SceneEntityCfg``. ``docs/isaaclab.md`` describes the differences.

Only ``managers``, ``markers``, and ``utils`` have source files. The import of this package creates all other modules,
which give Isaac Lab's names to existing classes, from ``_MODULES``.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.isaaclab_attributes import Simulation
from wheelleg_exp.isaaclab import managers, markers
from wheelleg_exp.isaaclab.utils import math
from wheelleg_exp.managers import Env, SceneEntityCfg
from wheelleg_exp.mdp import modifiers, noise, observations
from wheelleg_exp.mdp.events.randomization import Operation, operate
from wheelleg_exp.sim import actuators, sensors
from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.robot import Robot
from wheelleg_exp.sim.scene import Scene
from wheelleg_exp.sim.terrain import TerrainBase

_TERMS = ("actions", "commands", "curriculums", "events", "observations", "rewards", "terminations")
_MARKERS = (
    *("CONTACT_SENSOR_MARKER_CFG", "CUBOID_MARKER_CFG", "FRAME_MARKER_CFG", "POSITION_GOAL_MARKER_CFG"),
    *("RAY_CASTER_MARKER_CFG", "SPHERE_MARKER_CFG"),
    *("BLUE_ARROW_X_MARKER_CFG", "GREEN_ARROW_X_MARKER_CFG", "RED_ARROW_X_MARKER_CFG"),
)
_MODULES_OF_MANAGERS = ("action_manager", "command_manager", "manager_base", "manager_term_cfg", "scene_entity_cfg")


def _public(module: ModuleType) -> dict[str, object]:
    own = f"{module.__name__}."
    names = {n: v for n, v in vars(module).items() if not n.startswith("_") and not isinstance(v, ModuleType)}
    return {n: v for n, v in names.items() if f"{getattr(v, '__module__', module.__name__)}.".startswith(own)}


def _with_isaac_labs_parameters(stock: object) -> object:
    """Return a stock event that terms can call with Isaac Lab's parameters, which have no ``generator``.

    The event draws from torch's global generator, which is the random stream of the calling term. The result is a
    function, also for the stock events that are functions in Isaac Lab, but classes here.
    """
    is_class = inspect.isclass(stock)
    if not callable(stock) or (inspect.isclass(stock) and stock.__name__.startswith("randomize_")):
        return stock
    parameters = list(inspect.signature(stock).parameters)
    if parameters[:1] != ["env"] or "generator" not in parameters:
        return stock
    names = [name for name in parameters if name not in ("env", "env_ids", "generator")]

    @functools.wraps(stock, updated=() if is_class else ("__dict__",))
    def event(env: Env, env_ids: torch.Tensor | Sequence[int] | None, *values: Any, **settings: Any) -> None:
        env_ids = None if env_ids is None else torch.as_tensor(env_ids, device=env.device)
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


@functools.wraps(observations.joint_pos_limit_normalized, updated=())
def _joint_pos_limit_normalized(env: Env, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")) -> torch.Tensor:  # noqa: B008
    return observations.joint_pos_limit_normalized(env, asset_cfg)(env)


def _randomize_prop_by_op(
    data: torch.Tensor,
    distribution_parameters: tuple[math.Bound, math.Bound],
    dim_0_ids: torch.Tensor | None,
    dim_1_ids: torch.Tensor | slice,
    operation: Operation,
    distribution: str,
) -> torch.Tensor:
    """Change rows and columns of ``data`` by drawn values: a private function of Isaac Lab that many events call."""
    sample = getattr(math, f"sample_{distribution}")
    rows = torch.arange(data.shape[0], device=data.device)[slice(None) if dim_0_ids is None else dim_0_ids]
    columns = torch.arange(data.shape[1], device=data.device)[dim_1_ids]
    at = (rows.unsqueeze(1), columns)
    data[at] = operate(data[at], sample(*distribution_parameters, (len(rows), len(columns)), data.device), operation)
    return data


def _generic_io_descriptor(function: object = None, **_: object) -> object:
    """Return a term unchanged: descriptions of observations are not exported."""
    return function if callable(function) else _generic_io_descriptor


_RECORDED = ("shape", "dtype", "joint_names", "body_names", "joint_pos_offsets", "joint_vel_offsets")
_DESCRIPTORS = {"generic_io_descriptor": _generic_io_descriptor, **{f"record_{name}": None for name in _RECORDED}}
_ROBOT = {"Articulation": Robot, "ArticulationData": ArticulationData}
_BODY = {"RigidObject": Robot, "RigidObjectData": ArticulationData}
_TERMS_BY_KIND = {kind: _public(import_module(f"wheelleg_exp.mdp.{kind}")) for kind in _TERMS}
_EVENTS = _TERMS_BY_KIND["events"]
_EVENTS.update({name: _with_isaac_labs_parameters(event) for name, event in _EVENTS.items()})
_EVENTS["_randomize_prop_by_op"] = _randomize_prop_by_op
_TERMS_BY_KIND["observations"]["joint_pos_limit_normalized"] = _joint_pos_limit_normalized
# Observations of Isaac Lab 3.0, and their names here.
OF_VERSION_3 = {"pva_orientation": "imu_orientation", "pva_projected_gravity": "imu_projected_gravity"}
_TERMS_BY_KIND["observations"] |= {new: getattr(observations, old) for new, old in OF_VERSION_3.items()}
TERMS = {name: term for terms in _TERMS_BY_KIND.values() for name, term in terms.items()}
_ENVS = dict.fromkeys(("ManagerBasedEnv", "ManagerBasedRLEnv"), ManagerBasedRLEnv)
_SENSORS = {**_public(sensors), "TiledCamera": sensors.Camera, "Pva": sensors.Imu, "PvaData": sensors.ImuData}
_MANAGERS = {name: value for name, value in vars(managers).items() if not name.startswith("_")}
# Each entry of ``_MODULES`` defines a module: path, docstring, and members. A package precedes its modules.
_MODULES: dict[str, tuple[str, Mapping[str, object]]] = {
    **{name: ("The actuator models.", _public(actuators)) for name in ("actuators", "actuators.actuator_pd")},
    "assets": ("The robot.", {**_ROBOT, **_BODY, "AssetBase": Robot, "RigidObjectCollection": Robot}),
    "assets.articulation": ("The robot.", _ROBOT),
    "assets.articulation.articulation": ("The robot.", _ROBOT),
    "assets.articulation.articulation_data": ("The robot's state.", _ROBOT),
    "assets.rigid_object": ("The robot.", _BODY),
    "envs": ("The environment.", _ENVS),
    **{f"envs.{name}": ("The environment.", _ENVS) for name in ("manager_based_env", "manager_based_rl_env")},
    "envs.utils": ("Utilities.", {}),
    "envs.utils.io_descriptors": ("Descriptions of observations, which have no effect.", _DESCRIPTORS),
    "envs.mdp": ("The stock terms.", TERMS),
    **{f"envs.mdp.{kind}": (f"The stock {kind}.", terms) for kind, terms in _TERMS_BY_KIND.items()},
    "envs.mdp.actions.joint_actions": ("The stock actions of joints.", _TERMS_BY_KIND["actions"]),
    "envs.mdp.commands.velocity_command": ("The stock commands.", _TERMS_BY_KIND["commands"]),
    **{f"managers.{name}": ("Terms and managers.", _MANAGERS) for name in _MODULES_OF_MANAGERS},
    "markers.config": ("Markers.", dict.fromkeys(_MARKERS, markers.VisualizationMarkersCfg())),
    "scene": ("The scene.", {"InteractiveScene": Scene}),
    "sensors": ("The sensors of the scene.", _SENSORS),
    **{f"sensors.{name}": ("A sensor.", _SENSORS) for name in ("camera", "contact_sensor", "imu", "ray_caster")},
    **{f"sensors.{name}.{name}": ("A sensor.", _SENSORS) for name in ("camera", "contact_sensor", "imu", "ray_caster")},
    "sim": ("The simulation, for annotations.", {"SimulationContext": Simulation}),
    **{name: ("The ground.", {"TerrainImporter": TerrainBase}) for name in ("terrains", "terrains.terrain_importer")},
    "utils.modifiers": ("The modifiers of observations.", _public(modifiers)),
    "utils.noise": ("The noise of observations.", _public(noise)),
}


def make_modules(package: str, modules: Mapping[str, tuple[str, Mapping[str, object]]]) -> None:
    """Create the modules of ``package`` that ``modules`` defines, and make them importable by their dotted paths."""
    for path, (doc, members) in modules.items():
        module = ModuleType(f"{package}.{path}", doc)
        module.__spec__ = ModuleSpec(module.__name__, None, is_package=True)
        module.__path__ = []
        vars(module).update(members)
        sys.modules[module.__name__] = module
        parent, _, name = module.__name__.rpartition(".")
        setattr(sys.modules[parent], name, module)


make_modules(__name__, _MODULES)
