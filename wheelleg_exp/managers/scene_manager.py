"""Builds the scene from the config sections ``env.sim``, ``env.scene`` and ``env.robot``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import torch

from wheelleg_exp.constraints import Node
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.manager_base import build, table
from wheelleg_exp.managers.streams import Streams
from wheelleg_exp.sim.actuators import ActuatorBase
from wheelleg_exp.sim.options import EnvOptions, read_env
from wheelleg_exp.sim.scene import Scene
from wheelleg_exp.sim.sensors import SensorBase
from wheelleg_exp.sim.terrain import TerrainBase

_Part = TypeVar("_Part")


class SceneManager:
    """The scene of an environment's options; ``stream(key)`` returns a config key's generator, by default of seed 0."""

    def __init__(
        self,
        env: EnvOptions | Mapping[str, object],
        mjcf: Path,
        num_envs: int,
        stream: Callable[[str], torch.Generator] | None = None,
    ) -> None:
        env = read_env(env)
        scene, robot = env.scene, env.robot
        actuators = _built(robot.actuators, "env.robot.actuators", ActuatorBase)
        sensors = _built(scene.sensors, "env.scene.sensors", SensorBase)
        terrain = _built({"terrain": scene.terrain}, "env.scene", TerrainBase)["terrain"]
        self.scene = Scene(mjcf, num_envs, env.sim, scene, terrain, robot, actuators, sensors, stream or Streams(0).get)

    def __str__(self) -> str:
        robot, rows = self.scene.robot, []
        for i, name in enumerate(robot.joint_names):
            limits = "[{:.3g}, {:.3g}]".format(*robot.layout.joint_pos_limits[i].tolist())
            groups = ", ".join(g for g, a in robot.actuators.items() if name in a.joint_names) or "-"
            rows.append((i, name, f"{robot.layout.default_joint_pos[i]:.4f}", limits, groups))
        title = f"Robot ({robot.options.profile}): {len(robot.body_names)} bodies, {len(robot.joint_names)} joints"
        joints = table(title, ("index", "joint", "default (rad)", "limits (rad)", "actuators"), rows)
        sensed = [(n, type(s).__name__, ", ".join(s.body_names)) for n, s in self.scene.sensors.items()]
        sensors = table(f"Scene: {self.scene.num_envs} environments", ("sensor", "class", "bodies"), sensed)
        return f"{joints}\n{sensors}"


def _built(nodes: Mapping[str, Node | None], path: str, kind: type[_Part]) -> dict[str, _Part]:
    built: dict[str, _Part] = {}
    for name, node in nodes.items():
        if node is None:
            continue
        value = build(node, f"{path}.{name}")
        if not isinstance(value, kind):
            message = f"'{type(value).__name__}' is not a {kind.__name__}"
            raise ConfigError(message, key=f"{path}.{name}", expected=f"a _target_ of {kind.__name__}")
        built[name] = value
    return built
