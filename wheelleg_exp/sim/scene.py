"""The scene: ground, robot and sensors, assembled into one MuJoCo model and run N times."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import AssetError, ConfigError, nearest_name
from wheelleg_exp.sim.actuators import ActuatorBase
from wheelleg_exp.sim.contact import ContactSensor
from wheelleg_exp.sim.names import require_numbers
from wheelleg_exp.sim.options import RobotOptions, SceneOptions, SimOptions
from wheelleg_exp.sim.robot import Robot
from wheelleg_exp.sim.simulation import Simulation
from wheelleg_exp.sim.state import Kept

GROUND = "ground"
_ROBOT_PRIORITY = 1
_PLACES = ("paths", "npaths", "nbuffer")  # of a model: where its files lie, and what counts them


class Scene(Kept):
    """Ground plane, robot and sensors of N environments.

    Members are found by name, as in Isaac Lab: ``scene["robot"]``, ``scene["contact_forces"]``. Until ``play``
    the model is a spec that may still be edited.

    Args:
        mjcf: the robot's MJCF file.
        num_envs: number of environments, N.
        sim: the solver.
        scene: ground and spacing.
        robot: the robot's options.
        actuators: the robot's actuator groups by name.
        sensors: sensors by name.
    """

    def __init__(
        self,
        mjcf: Path,
        num_envs: int,
        sim: SimOptions,
        scene: SceneOptions,
        robot: RobotOptions,
        actuators: Mapping[str, ActuatorBase],
        sensors: Mapping[str, ContactSensor],
    ) -> None:
        self.num_envs = num_envs
        self.options = scene
        spec = _robot_spec(mjcf)
        root_name = _root_body(spec, mjcf)
        _set_options(spec, sim)
        _set_self_collisions(spec, robot.self_collisions)
        self._add_ground(spec)
        self._effective_friction(spec, robot.friction_source)
        self.robot = Robot(robot, actuators, spec, root_name)
        self.sensors = dict(sensors)
        for name, sensor in self.sensors.items():
            sensor.add_to(spec, name, self.robot.body_names)
        self.spec = spec
        self._nthread = sim.nthread
        self.env_origins = grid_origins(num_envs, scene.env_spacing)

    def play(self) -> None:
        """Compile the spec, start the simulations and stand the robot at its default state."""
        self.model = self.spec.compile()
        self.sim = Simulation(self.model, self.num_envs, self._nthread)
        self.robot.connect(self.sim)
        for sensor in self.sensors.values():
            sensor.connect(self.sim)
        self._place_at_defaults()

    def __getitem__(self, name: str) -> Any:
        if name == "robot":
            return self.robot
        return self.sensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(("robot", *self.sensors))

    def contact_sensor(self, name: str) -> ContactSensor:
        """Return a contact sensor by name; ConfigError when the member is none."""
        sensor = self.sensors.get(name)
        if not isinstance(sensor, ContactSensor):
            raise ConfigError(
                f"'{name}' is no contact sensor",
                key="sensor_cfg.name",
                expected="one of " + (", ".join(self.sensors) or "(the scene has none)"),
                nearest=nearest_name(name, self.sensors),
            )
        return sensor

    def model_digest(self) -> str:
        """Return the sha256 of the compiled model, the identity of everything that physics reads."""
        return model_digest(self.model)

    def write_data_to_sim(self) -> None:
        """Run the actuators and write controls and wrenches, before each physics step."""
        self.robot.write_data_to_sim()

    def update(self) -> None:
        """Take up the results of the physics step that has just run."""
        self.robot.data.mark_stepped()
        for sensor in self.sensors.values():
            sensor.update()

    def reset(self, ids: torch.Tensor) -> None:
        """Reset simulations, then assets, then sensors; the state itself is the reset events' job."""
        self.sim.reset(ids)
        self.robot.reset(ids)
        for sensor in self.sensors.values():
            sensor.reset(ids)

    def diagnostics(self, ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return what the log says of limits that MuJoCo or a sensor could not keep, over episodes that end now.

        ``joint_over_speed``: share of ``ids`` with a joint beyond its velocity limit in its last step, which PhysX
        would have clamped. ``<sensor>_overflow``: share with more contacts on one body than the sensor sums.
        """
        data = self.robot.data
        fast = (data.joint_vel[ids].abs() > data.soft_joint_vel_limits).any(dim=1)
        log = {"Diagnostics/joint_over_speed": fast.float().mean()}
        for name, sensor in self.sensors.items():
            log[f"Diagnostics/{name}_overflow"] = sensor.overflowed(ids).float().mean()
        return log

    def refresh(self) -> None:
        """Make derived quantities describe the new state of the environments whose state was written."""
        stale = self.robot.stale
        if stale.any():
            self.sim.forward(stale.nonzero().squeeze(1))
            stale.fill_(False)
        self.robot.data.invalidate()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of physics, robot and sensors."""
        return {
            "sim": self.sim.state_dict(),
            "robot": self.robot.state_dict(),
            "sensors": {name: sensor.state_dict() for name, sensor in self.sensors.items()},
            "env_origins": self.env_origins.clone(),
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.sim.load_state_dict(saved["sim"])
        self.robot.load_state_dict(saved["robot"])
        for name, sensor in self.sensors.items():
            sensor.load_state_dict(saved["sensors"][name])
        self.env_origins.copy_(saved["env_origins"])

    def _add_ground(self, spec: mujoco.MjSpec) -> None:
        ground = self.options.ground
        spec.worldbody.add_geom(
            name=GROUND,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.05],
            friction=[ground.dynamic_friction, 0.005, 0.0001],
            rgba=[0.35, 0.38, 0.42, 1],
        )

    def _effective_friction(self, spec: mujoco.MjSpec, source: str) -> None:
        """Give robot geoms PhysX's average with the ground, which the higher priority makes MuJoCo use."""
        ground = self.options.ground.static_friction if source == "static" else self.options.ground.dynamic_friction
        for geom in spec.geoms:
            if geom.name != GROUND and (geom.contype or geom.conaffinity):
                geom.priority = _ROBOT_PRIORITY
                geom.friction[0] = (geom.friction[0] + ground) / 2

    def _place_at_defaults(self) -> None:
        robot, ids = self.robot, torch.arange(self.num_envs)
        if robot.floating:
            pos = robot.default_root_pos + self.env_origins
            robot.write_root_pose(ids, pos, robot.default_root_quat.expand(self.num_envs, 4))
        robot.write_joint_state(ids, robot.data.default_joint_pos, robot.data.default_joint_vel)
        self.refresh()


def grid_origins(num_envs: int, spacing: float) -> torch.Tensor:
    """Return the origins (N, 3) of environments on a square grid around the world's origin, row by row.

    Layout as in Isaac Lab: ``rows = ceil(N / floor(sqrt(N)))``, x falls with the row, y grows with the column
    mirrored about the centre.
    """
    rows = math.ceil(num_envs / math.floor(math.sqrt(num_envs)))
    cols = math.ceil(num_envs / rows)
    i, j = torch.meshgrid(torch.arange(rows), torch.arange(cols), indexing="ij")
    origins = torch.zeros(num_envs, 3)
    origins[:, 0] = (-(i.flatten()[:num_envs] - (rows - 1) / 2)) * spacing
    origins[:, 1] = (j.flatten()[:num_envs] - (cols - 1) / 2) * spacing
    return origins


def model_digest(model: mujoco.MjModel) -> str:
    """Return the sha256 of all numbers and names of a model, but not of the places of its files."""
    digest = hashlib.sha256()
    for holder in (model, model.opt):
        for name in sorted(dir(holder)):
            if name.startswith("_") or name in _PLACES or name.endswith("pathadr"):
                continue
            value = getattr(holder, name)
            if isinstance(value, (np.ndarray, np.generic, int, float, bytes)):
                digest.update(name.encode() + b"\0" + np.asarray(value).tobytes())
    return digest.hexdigest()


def _robot_spec(mjcf: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(mjcf))
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise AssetError(f"MuJoCo cannot read it: {reason}", key=str(mjcf), expected="an MJCF file") from error
    # Controls and initial state come from the config.
    for element in [*spec.actuators, *spec.keys, *spec.sensors]:
        spec.delete(element)
    return spec


def _root_body(spec: mujoco.MjSpec, mjcf: Path) -> str:
    roots = [body for body in spec.worldbody.bodies if body.joints or body.bodies]
    if len(roots) != 1:
        raise AssetError(
            f"the file holds {len(roots)} robots", key=str(mjcf), expected="exactly one tree of moving bodies"
        )
    return str(roots[0].name)


def _set_self_collisions(spec: mujoco.MjSpec, wanted: bool | None) -> None:
    """Let the robot's geoms meet each other or the ground alone; excluded pairs of bodies stay excluded."""
    if wanted is None:
        return
    for geom in spec.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = int(wanted), 1


def _set_options(spec: mujoco.MjSpec, sim: SimOptions) -> None:
    require_numbers(sim.gravity, 3, "env.sim.gravity")
    option = spec.option
    option.timestep = sim.dt
    option.gravity = sim.gravity
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{sim.integrator.upper()}")
    option.solver = getattr(mujoco.mjtSolver, f"mjSOL_{sim.solver.upper()}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{sim.cone.upper()}")
    option.iterations = sim.iterations
    option.ls_iterations = sim.ls_iterations
    option.tolerance = sim.tolerance
    option.impratio = sim.impratio
