"""The scene: ground, robot and sensors, assembled into one MuJoCo model and run N times."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.sim.actuators import ActuatorBase
from wheelleg_exp.sim.engine import WRENCHES, Engine
from wheelleg_exp.sim.options import RobotOptions, SceneOptions, SimOptions, engine_kind
from wheelleg_exp.sim.robot import ACTUATORS_KEY, Robot
from wheelleg_exp.sim.robot_model import read_robot, turn_root_frame
from wheelleg_exp.sim.sensors import ContactSensor, SensorBase, require_base_called
from wheelleg_exp.sim.terrain import GROUND_GROUP, TERRAIN_KEY, TerrainBase, combined_friction, is_ground
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_binding import TARGET, resolve_target
from wheelleg_exp.terms.term_errors import blamed

RobotState = Mapping[str, Mapping[str, Mapping[str, torch.Tensor]]]
_ROBOT_PRIORITY, _ROBOT_GROUP = 1, 1
_FILE_PATHS = ("paths", "npaths", "nbuffer")  # The checksum of a model skips its fields of file paths.


class Scene(Stateful):
    """The ground, the robot and the sensors of N environments.

    Members have Isaac Lab's names: ``scene["robot"]``, ``scene["terrain"]``, ``scene["<sensor>"]``. Until ``play``, the
    model is a MuJoCo spec that event terms can edit. ``stream`` returns a random generator for a config key.
    """

    def __init__(
        self,
        mjcf: Path,
        num_envs: int,
        sim: SimOptions,
        scene: SceneOptions,
        terrain: TerrainBase,
        robot: RobotOptions,
        actuators: Mapping[str, ActuatorBase],
        sensors: Mapping[str, SensorBase],
        stream: Callable[[str], torch.Generator],
    ) -> None:
        self.num_envs = num_envs
        self.options = scene
        self.terrain = self.child("terrain", terrain)
        self.device = torch.device(sim.device)
        spec, root_name = read_robot(mjcf)
        if robot.root_frame is not None:
            turn_root_frame(spec, root_name, robot.root_frame)
        spec.option.timestep = sim.dt
        for name in ("gravity", "iterations", "ls_iterations", "tolerance", "impratio"):
            setattr(spec.option, name, getattr(sim, name))
        spec.option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{sim.integrator.upper()}")
        spec.option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{sim.solver.upper()}")
        spec.option.cone = getattr(mujoco.mjtCone, f"mjCONE_{sim.cone.upper()}")
        for geom in spec.geoms if robot.self_collisions is not None else ():
            if geom.contype or geom.conaffinity:  # Body pairs that the robot's file excludes never collide.
                geom.contype, geom.conaffinity = int(robot.self_collisions or False), 1
        with blamed(TERRAIN_KEY, terrain):
            terrain.read_files(mjcf.parent)
            terrain.place(num_envs, scene.env_spacing, self.device, partial(stream, TERRAIN_KEY))
            terrain.lay(spec)
        self.env_origins = self.buffer("env_origins", terrain.env_origins)
        _set_geoms(spec, robot, terrain.friction(robot.friction_source))
        for name, actuator in actuators.items():
            with blamed(f"{ACTUATORS_KEY}.{name}", actuator):
                actuator.read_files(mjcf.parent, f"{ACTUATORS_KEY}.{name}", self.device)
        self.robot = self.child("robot", Robot(robot, actuators, spec, root_name, self.device))
        self.sensors = self.child("sensors", dict(sensors))
        for name, sensor in self.sensors.items():
            sensor.name, sensor.terrain = name, terrain
            with blamed(sensor.key, sensor):
                sensor.add_to(spec, name, self.robot)
            require_base_called(sensor, "body_names", "add_to(spec, name, robot)")
        self.spec = spec
        self._sim_options = sim
        self.physics_dt = sim.dt
        self._stream = stream

    def play(self) -> None:
        """Compile the spec, start the simulations, and put the robot into its default state."""
        self.model, options = self.spec.compile(), self._sim_options
        self._compiled = _checksums(self.model)
        key, node = "env.sim.engine", {} if isinstance(options.engine, str) else options.engine
        arguments = {name: value for name, value in node.items() if name != TARGET}
        # The module of an engine is imported only now, because it can import large optional packages.
        kind = resolve_target(engine_kind(options.engine).target, key)
        if not (isinstance(kind, type) and issubclass(kind, Engine)):
            raise ConfigError(f"'{kind.__name__}' is not an Engine", key=key, expected="a _target_ of Engine")
        self.sim = kind.from_config(self.model, self.num_envs, options, self.robot.options, **arguments)
        self.child("sim", self.sim, saved=False)
        self.sim.cast_alone(GROUND_GROUP, lambda: self.terrain.probe.model)
        unstable = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._unstable: torch.Tensor | None = self.buffer("_unstable", unstable, saved=False)
        self.robot.connect(self.sim, self._stream)
        for sensor in self.sensors.values():
            with blamed(sensor.key, sensor):
                sensor.connect(self.sim, partial(self._stream, sensor.key))
            require_base_called(sensor, "_sim", "connect(sim, stream)")
        robot, data = self.robot, self.robot.data
        if robot.floating:
            pose = data.default_root_state[:, :7].clone()
            pose[:, :3] += self.env_origins
            robot.write_root_pose_to_sim(pose)
        robot.write_joint_state_to_sim(data.default_joint_pos, data.default_joint_vel)
        self.refresh()

    def __getitem__(self, name: str) -> Any:
        if name == "robot":
            return self.robot
        return self.terrain if name == "terrain" else self.sensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(("robot", "terrain", *self.sensors))

    def keys(self) -> list[str]:
        """Return the names of the robot, the ground and the sensors in the scene."""
        return list(self)

    @property
    def cfg(self) -> SimpleNamespace:
        """Settings of the scene with Isaac Lab's attribute names, for terms that were written for Isaac Lab."""
        return SimpleNamespace(num_envs=self.num_envs, env_spacing=self.options.env_spacing, terrain=self.terrain.cfg)

    @property
    def env_regex_ns(self) -> str:
        """Isaac Lab's expression for the paths of all environments; there is no USD stage, so it matches nothing."""
        return "/World/envs/env_.*"

    @property
    def articulations(self) -> dict[str, Robot]:
        """A dictionary that maps the name of the scene's only robot to the robot."""
        return {"robot": self.robot}

    @property
    def rigid_objects(self) -> dict[str, object]:
        """An empty dictionary of rigid objects, because the robot is the only moving body of the scene."""
        return {}

    def contact_sensor(self, name: str) -> ContactSensor:
        """Return a contact sensor by name; raise ConfigError if no contact sensor has that name."""
        sensor = self.sensors.get(name)
        if not isinstance(sensor, ContactSensor):
            expected = "one of " + (", ".join(self.sensors) or "(the scene has none)")
            message, nearest = f"'{name}' is not a contact sensor", nearest_name(name, self.sensors)
            raise ConfigError(message, key="sensor_cfg.name", expected=expected, nearest=nearest)
        return sensor

    def model_digest(self) -> str:
        """Return the sha256 of the compiled model, including every value that the physics depends on."""
        return model_digest(self.model)

    def require_compiled_model(self) -> None:
        """Raise ConfigError, which names the changed fields, if a manager term has written to the compiled model."""
        # The engine simulates a copy of the MuJoCo model, so a write to the original model has no effect.
        now = _checksums(self.model)
        if changed := [name for name, value in self._compiled.items() if now[name] != value]:
            raise ConfigError(
                f"a term has changed {' and '.join(changed)} of the compiled model. The engine simulates a copy "
                "of this model, so the change has no effect, and no checkpoint saves it",
                key="env.scene.sim.model",
                expected=f"env.scene.sim.expand('{changed[0]}'), a tensor with one value for each environment, and "
                "env.scene.sim.set_const() after writing to it",
            )

    def write_data_to_sim(self) -> None:
        """Compute the actuators' controls, and write the controls and the external wrenches to the engine."""
        self.robot.write_data_to_sim()

    def unstable(self) -> torch.Tensor:
        """Return a mask (N,) of the simulations that have NaN or huge values after the last physics step."""
        if self._unstable is None:
            self._unstable = self.sim.unstable()
        return self._unstable

    def motion(self) -> dict[str, torch.Tensor]:
        """Return qpos and qvel of all simulations, (N, ...), by the names ``positions`` and ``velocities``."""
        return {"positions": self.sim.view("qpos"), "velocities": self.sim.view("qvel")}

    def get_state(self, is_relative: bool = False) -> RobotState:
        """Return the robot's state in Isaac Lab's layout: ``["articulation"]["robot"]`` and these names.

        ``root_pose`` (N, 7): position, m, and quaternion (w, x, y, z); relative to the environment's origin with
        ``is_relative``. ``root_velocity`` (N, 6): of the root's centre of mass, world axes, m/s and rad/s.
        ``joint_position`` and ``joint_velocity`` (N, J): rad and rad/s.
        """
        data = self.robot.data
        pos = data.root_pos_w - self.env_origins if is_relative else data.root_pos_w
        velocity = torch.cat((data.root_lin_vel_w, data.root_ang_vel_w), dim=1)
        root = {"root_pose": torch.cat((pos, data.root_quat_w), dim=1), "root_velocity": velocity}
        joints = {"joint_position": data.joint_pos, "joint_velocity": data.joint_vel}
        return {"articulation": {"robot": root | joints}}

    def reset_to(self, state: RobotState, env_ids: torch.Tensor | None = None, is_relative: bool = False) -> None:
        """Set the environments ``env_ids`` (n,), by default all, to the rows of ``state``, as of ``get_state``."""
        robot, given = self.robot, state["articulation"]["robot"]
        pos, quat = given["root_pose"].split((3, 4), dim=1)
        if is_relative:
            pos = pos + (self.env_origins if env_ids is None else self.env_origins[env_ids])
        robot.write_root_pose_to_sim(torch.cat((pos, quat), dim=1), env_ids)
        robot.write_root_velocity_to_sim(given["root_velocity"], env_ids)
        robot.write_joint_state_to_sim(given["joint_position"], given["joint_velocity"], env_ids=env_ids)

    def written(self, asked: Collection[str]) -> dict[str, torch.Tensor]:
        """Return the tensors with the names ``asked``: model fields and wrenches that terms may have changed."""
        wrenches = {WRENCHES: self.robot.permanent_wrench} if WRENCHES in asked else {}
        fields = sorted({*asked} - {WRENCHES})
        return wrenches | {f"the model's {name}": self.sim.expanded[name] for name in fields}

    def update(self) -> None:
        """Update the robot and the sensors after a physics step."""
        self._unstable = None
        self.robot.data.mark_stepped()
        for sensor in self.sensors.values():
            with blamed(sensor.key, sensor, has_worked=True):
                sensor.update()

    def reset(self, ids: torch.Tensor) -> None:
        """Reset the simulations, then the robot, then the sensors; afterwards, reset events set the new state."""
        self.sim.reset(ids)
        self._unstable = self.unstable().index_fill(0, ids, False)
        self.robot.reset(ids)
        for sensor in self.sensors.values():
            with blamed(sensor.key, sensor, has_worked=True):
                sensor.reset(ids)

    def diagnostics(self, ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return log entries, by name, about joints and sensors in the environments whose episodes end now.

        ``joint_over_speed`` is the share with a joint beyond its velocity limit, which PhysX would have enforced.
        """
        data = self.robot.data
        speed, limit = data.joint_vel.index_select(0, ids).abs(), data.soft_joint_vel_limits.index_select(0, ids)
        log = {"Diagnostics/joint_over_speed": (speed > limit).any(dim=1).mean(dtype=torch.float32)}
        for name, sensor in self.sensors.items():
            log |= {f"Diagnostics/{name}_{word}": value for word, value in sensor.diagnostics(ids).items()}
        return log

    def refresh(self) -> None:
        """Recompute link poses and sensor data after writes of the robot's state, and clear the robot's cache."""
        self.show_written()
        self.robot.data.invalidate()

    def show_written(self) -> None:
        """Recompute link poses and sensor data of the environments whose robot state was written."""
        if (ids := self.robot.take_stale()) is not None:
            self.sim.forward(ids)
            self.robot.data.outputs_refreshed()
            for sensor in self.sensors.values():
                with blamed(sensor.key, sensor, has_worked=True):
                    sensor.refresh(ids)

    def state_dict(self) -> dict[str, object]:
        return {"sim": self.sim.state_dict(), **super().state_dict()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        self.sim.load_state_dict(saved["sim"])
        self._unstable = self.sim.unstable()
        super().load_state_dict(saved)


def _set_geoms(spec: mujoco.MjSpec, robot: RobotOptions, ground_friction: float) -> None:
    for geom in spec.geoms:
        if is_ground(geom.name):
            geom.group = GROUND_GROUP
            continue
        geom.group = _ROBOT_GROUP if geom.group == GROUND_GROUP else geom.group
        if geom.contype or geom.conaffinity:
            # In each contact of robot and ground, PhysX combines the two friction coefficients.
            # MuJoCo uses the friction of the geom with higher priority, so raise the priority of the robot's geoms.
            geom.priority = _ROBOT_PRIORITY
            geom.friction[0] = combined_friction(geom.friction[0], ground_friction, robot.friction_combine_mode)


def model_digest(model: mujoco.MjModel) -> str:
    """Return the sha256 of all numbers and names of a model, without the paths of its files."""
    digest = hashlib.sha256()
    for name, value in _fields(model):
        digest.update(name.removeprefix("opt.").encode() + b"\0" + value.tobytes())
    return digest.hexdigest()


def _fields(model: mujoco.MjModel) -> Iterator[tuple[str, np.ndarray]]:
    for prefix, holder in (("", model), ("opt.", model.opt)):
        for name in sorted(dir(holder)):
            if name.startswith("_") or name in _FILE_PATHS or name.endswith("pathadr"):
                continue
            value = getattr(holder, name)
            if isinstance(value, (np.ndarray, np.generic, int, float, bytes)):
                yield prefix + name, np.asarray(value)


def _checksums(model: mujoco.MjModel) -> dict[str, int]:
    return {name: zlib.crc32(np.ascontiguousarray(value).data) for name, value in _fields(model)}
