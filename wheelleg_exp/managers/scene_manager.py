"""Builds the scene from the ``env.sim``, ``env.scene`` and ``env.robot`` sections."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers.manager_base import table
from wheelleg_exp.managers.term import build
from wheelleg_exp.sim.actuators import ActuatorBase
from wheelleg_exp.sim.contact import ContactSensor
from wheelleg_exp.sim.options import RobotOptions, SceneOptions, SimOptions
from wheelleg_exp.sim.scene import Scene

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Options = TypeVar("_Options", bound="DataclassInstance")


class SceneManager:
    """The scene and what it was built from.

    Args:
        cfg: the composed ``env`` section.
        mjcf: the robot's MJCF file.
        num_envs: number of environments.

    Raises:
        ConfigError: a section lacks a key or holds an unknown one, or a node is wrong.
    """

    def __init__(self, cfg: Mapping[str, Any], mjcf: Path, num_envs: int) -> None:
        sim = read_options(SimOptions, cfg["sim"], "env.sim")
        scene = read_options(SceneOptions, cfg["scene"], "env.scene")
        robot = read_options(RobotOptions, cfg["robot"], "env.robot")
        actuators = _built(robot.actuators, "env.robot.actuators", ActuatorBase)
        sensors = _built(scene.sensors, "env.scene.sensors", ContactSensor)
        self.scene = Scene(mjcf, num_envs, sim, scene, robot, actuators, sensors)

    def __str__(self) -> str:
        robot = self.scene.robot
        joints = table(
            f"Robot ({robot.options.profile}): {len(robot.body_names)} bodies, {len(robot.joint_names)} joints",
            ("index", "joint", "default (rad)", "limits (rad)", "actuators"),
            [
                (
                    index,
                    name,
                    f"{robot.default_joint_pos[index]:.4f}",
                    "[{:.3g}, {:.3g}]".format(*robot.joint_pos_limits[index].tolist()),
                    ", ".join(g for g, a in robot.actuators.items() if name in a.joint_names) or "-",
                )
                for index, name in enumerate(robot.joint_names)
            ],
        )
        sensors = table(
            f"Scene: {self.scene.num_envs} environments",
            ("sensor", "class", "bodies"),
            [(n, type(s).__name__, ", ".join(s.body_names)) for n, s in self.scene.sensors.items()],
        )
        return f"{joints}\n{sensors}"


def read_options(kind: type[_Options], section: Mapping[str, Any], path: str) -> _Options:
    """Return a section as its dataclass.

    Raises:
        ConfigError: a key is missing or unknown.
    """
    hints = get_type_hints(kind)
    for name in section:
        if name not in hints:
            expected, nearest = ", ".join(hints), nearest_name(name, hints)
            raise ConfigError("unknown key", key=f"{path}.{name}", expected=expected, nearest=nearest)
    optional = {item.name for item in fields(kind) if item.default is not MISSING}
    missing = [name for name in hints if name not in section and name not in optional]
    if missing:
        raise ConfigError(f"'{missing[0]}' is missing", key=path, expected=", ".join(hints))
    nested = {name for name, hint in hints.items() if is_dataclass(hint)}
    values = {n: read_options(hints[n], v, f"{path}.{n}") if n in nested else v for n, v in section.items()}
    return kind(**values)


def _built(nodes: Mapping[str, Any], path: str, kind: type) -> dict[str, Any]:
    built = {name: build(node, f"{path}.{name}") for name, node in nodes.items() if node is not None}
    for name, value in built.items():
        if not isinstance(value, kind):
            raise ConfigError(f"is no {kind.__name__}", key=f"{path}.{name}", expected=f"a _target_ of {kind.__name__}")
    return built
