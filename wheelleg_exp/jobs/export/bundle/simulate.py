"""Simulate the bundle's robot and policy in MuJoCo, as in ``python simulate.py --seconds 20 --command 0.2 0 0``.

``simulate.py`` needs numpy and mujoco (``--view``: also a display; ``--onnx``: also onnxruntime or onnx).
``simulate.py`` exits with status 1 if the robot fell. ``robot/scene.xml`` places the training's robot on level ground.
The simulated motor drives compute torques as in training.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from runner import Policy, array, projected_gravity

HERE = Path(__file__).parent
LAWS = ("implicit", "pd", "dc_motor")
HEAVY = 1e6  # factor on the base's mass, which makes the base of a ``HungRobot`` immovable
FALLEN = 0.5  # A robot counts as fallen above a tilt of 60 degrees, whose cosine is 0.5.


class Robot:
    """The simulated robot: its readings, and drives that take targets; each actuator has the name of its joint."""

    def __init__(self, spec: Any, scene: Path = HERE / "robot" / "scene.xml") -> None:
        self.spec = spec
        self.model = mujoco.MjModel.from_xml_path(str(scene))
        self.model.opt.timestep = spec["physics_dt"]  # MuJoCo's XML file stores only six digits of the physics step.
        self.data = mujoco.MjData(self.model)
        self.commands: dict[str, np.ndarray] = {}
        joints = [self.model.joint(name) for name in spec["joint_names"]]
        self.qpos = [int(joint.qposadr[0]) for joint in joints]
        self.qvel = [int(joint.dofadr[0]) for joint in joints]
        driven = {self.model.actuator(i).name: i for i in range(self.model.nu)}
        self.drives = [(drive, [driven[name] for name in drive["joint_names"]]) for drive in spec["actuators"]]
        for drive, _ in self.drives:
            if drive["law"] not in LAWS:
                raise SystemExit(f"simulate.py cannot simulate the motor '{drive['name']}', a {drive['class']}")
        if not spec["root"]["floating"]:
            raise SystemExit("simulate.py cannot simulate this robot, because its base is fixed")
        missing = [name for name in spec["readings"] if name.endswith(".lin_acc")]
        if missing:
            raise SystemExit(f"simulate.py cannot simulate the sensor reading '{missing[0]}'")
        self.root = self.model.body(spec["root"]["body"])
        self.reset()

    def reset(self) -> None:
        """Place the simulated robot in its default pose."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:7] = [*self.spec["root"]["pos"], *self.spec["root"]["quat"]]
        self.data.qpos[self.qpos] = self.spec["default_joint_pos"]
        self.data.qvel[self.qvel] = self.spec["default_joint_vel"]
        mujoco.mj_forward(self.model, self.data)

    def readings(self, commands: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the values of the sensor readings and commands that the policy needs, by name."""
        data, effort = self.data, np.zeros(len(self.qpos))
        for drive, actuators in self.drives:
            effort[drive["joint_ids"]] = data.actuator_force[actuators]
        back = np.empty(4)
        mujoco.mju_negQuat(back, data.qpos[3:7])
        velocity = np.empty(3)
        mujoco.mju_rotVecQuat(velocity, data.qvel[:3], back)
        return {
            "base_ang_vel": data.qvel[3:6],  # For a free joint, MuJoCo gives the angular velocity in the body frame.
            "base_quat": data.qpos[3:7],
            "base_lin_vel": velocity + np.cross(data.qvel[3:6], self.root.ipos),
            "base_height": data.qpos[2:3],
            "joint_pos": data.qpos[self.qpos],
            "joint_vel": data.qvel[self.qvel],
            "joint_effort": effort,
            **{f"commands.{name}": command for name, command in commands.items()},
            **self.imu_readings(),
        }

    def imu_readings(self) -> dict[str, np.ndarray]:
        """Return the readings of the robot's IMUs, without sensor errors."""
        found: dict[str, np.ndarray] = {}
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)
        for name, imu in self.spec["imus"].items():
            body, velocity, quat, rate, back = self.model.body(imu["body"]).id, *map(np.empty, (6, 4, 3, 4))
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
            mujoco.mju_mulQuat(quat, self.data.xquat[body], imu["quat"])
            mujoco.mju_negQuat(back, imu["quat"])
            mujoco.mju_rotVecQuat(rate, velocity[:3], back)
            found |= {f"{name}.ang_vel": rate, f"{name}.quat": quat}
            found |= {f"{name}.projected_gravity": projected_gravity(quat)}
        return found

    def drive(self, targets: Mapping[str, np.ndarray]) -> None:
        """Convert joint targets into MuJoCo controls; the caller must call this method before each physics step."""
        q, qd = self.data.qpos[self.qpos], self.data.qvel[self.qvel]
        for drive, actuators in self.drives:
            ids, limit = drive["joint_ids"], array(drive["effort_limit"], np.inf)
            kp, kd = array(drive["stiffness"]), array(drive["damping"])
            torque = kp * targets["position"][ids] + kd * targets["velocity"][ids] + targets["effort"][ids]
            if drive["law"] != "implicit":  # For implicit actuators, MuJoCo itself computes the PD law.
                torque = np.clip(torque - kp * q[ids] - kd * qd[ids], -limit, limit)
            if drive["law"] == "dc_motor":
                stall, top = array(drive["saturation_effort"]), array(drive["velocity_limit"], np.inf)
                beyond = top * (1 + limit / stall)
                speed = np.clip(qd[ids], -beyond, beyond) / top
                low, high = np.maximum(stall * (-1 - speed), -limit), np.minimum(stall * (1 - speed), limit)
                torque = np.clip(torque, low, high)
            self.data.ctrl[actuators] = torque

    def approached(self, name: str, asked: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the next command on the way to ``asked``, within the acceleration limits of the training."""
        now = self.commands.setdefault(name, np.zeros(len(asked)))
        most = array(self.spec["command_accelerations"].get(name, [None] * len(asked)), np.inf) * self.spec["step_dt"]
        now += np.clip(np.asarray(asked) - now, -most, most)
        return now

    def step(self, policy: Policy, commands: Mapping[str, Sequence[float] | np.ndarray]) -> None:
        """Advance by one control step."""
        targets = policy.step(self.readings({name: self.approached(name, asked) for name, asked in commands.items()}))
        for _ in range(self.spec["decimation"]):
            self.drive(targets)
            mujoco.mj_step(self.model, self.data)
            targets = policy.targets(self.data.qpos[self.qpos])

    @property
    def upright(self) -> float:
        """Cosine of the tilt."""
        return -float(projected_gravity(self.data.qpos[3:7])[2])


class HungRobot(Robot):
    """The simulated robot with an immovable base, one metre above the ground, and drives that run at 1 kHz."""

    def __init__(self, spec: Any, scene: Path = HERE / "robot" / "scene.xml") -> None:
        x, y, z = spec["root"]["pos"]
        super().__init__({**spec, "root": {**spec["root"], "pos": [x, y, z + 1.0]}}, scene)
        self.model.body_mass[self.root.id] *= HEAVY
        self.model.body_inertia[self.root.id] *= HEAVY
        self.steps = max(1, round(1000 * spec["step_dt"]))
        self.model.opt.timestep = spec["step_dt"] / self.steps
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER  # explicit drives, as on a robot
        self.model.opt.tolerance = 0.0  # MuJoCo scales the tolerance by the mean inertia, which the base makes huge.
        mujoco.mj_setConst(self.model, self.data)
        self.reset()

    def reset(self) -> None:
        """Place the robot in its default pose, and compensate the weight of the base."""
        super().reset()
        self.data.xfrc_applied[self.root.id, :3] = -self.model.opt.gravity * self.model.body_mass[self.root.id]

    def play(self, chirps: Any) -> list[dict[str, float]]:
        """Return the log of all chirps."""
        rows = []
        for step in range(chirps.steps):
            readings = self.readings({})
            readings["projected_gravity"] = projected_gravity(readings["base_quat"])
            rows.append(chirps.row(step * chirps.dt, readings, step))
            self.advance(chirps.targets(step))
        return rows

    def advance(self, targets: Mapping[str, np.ndarray]) -> None:
        """Advance by one control step, and put the base back into its place."""
        for _ in range(self.steps):
            self.drive(targets)
            mujoco.mj_step(self.model, self.data)
        self.data.qpos[:7], self.data.qvel[:6] = [*self.spec["root"]["pos"], *self.spec["root"]["quat"]], 0.0


def outside(ranges: Mapping[str, Sequence[float]], command: Sequence[float] | np.ndarray) -> list[str]:
    """Return a warning for each component of a command that is outside the command range of the training."""
    if len(ranges) != len(command) or any(len(pair) != 2 for pair in ranges.values()):
        return []
    parts = zip(ranges.items(), command, strict=True)
    missed = ((axis, value, *pair) for (axis, pair), value in parts if not pair[0] <= value <= pair[1])
    return [f"{axis} {value:g}, trained {low:g} to {high:g}" for axis, value, low, high in missed]


def main() -> int:
    """Simulate the robot for ``--seconds`` seconds, and print the robot's tilt and height."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0, help="how long")
    parser.add_argument("--command", type=float, nargs="+", default=None, help="what is asked for; zeros by default")
    parser.add_argument("--view", action="store_true", help="show it in MuJoCo's viewer, in real time")
    parser.add_argument("--onnx", action="store_true", help="run policy.onnx, with onnxruntime or onnx")
    args = parser.parse_args()
    spec = json.loads((HERE / "policy.json").read_text(encoding="utf-8"))
    if not spec["step_dt"] <= args.seconds < np.inf:
        parser.error(f"--seconds is {args.seconds:g}, and has to be a number of at least {spec['step_dt']:.4g}")
    policy, robot = Policy(HERE, args.onnx), Robot(spec)
    widths = {name: spec["readings"][f"commands.{name}"]["width"] for name in spec["commands"]}
    if args.command is not None and list(widths.values()) != [len(args.command)]:
        parser.error(f"--command takes one command, and this policy has {widths}")
    if args.command is not None and not np.isfinite(args.command).all():
        parser.error("--command takes finite numbers")
    commands = {name: np.zeros(width) if args.command is None else args.command for name, width in widths.items()}
    for name, command in commands.items():
        for words in outside(spec["commands"][name], command):
            print(f"note: {name} is outside of its range: {words}")
    view: Any = nullcontext()
    if args.view:
        import mujoco.viewer

        view = mujoco.viewer.launch_passive(robot.model, robot.data)
    heights, fallen = [], None
    start = time.monotonic()
    with view as viewer:
        for step in range(round(args.seconds / spec["step_dt"])):
            robot.step(policy, commands)
            heights.append(robot.data.qpos[2])
            if robot.upright < FALLEN:
                fallen = (step + 1) * spec["step_dt"]
                break
            if viewer is not None:
                viewer.sync()
                time.sleep(max(0.0, start + (step + 1) * spec["step_dt"] - time.monotonic()))
    x, y = robot.data.qpos[:2] - spec["root"]["pos"][:2]
    print(f"simulated {len(heights) * spec['step_dt']:.2f} s at {1 / spec['step_dt']:.4g} Hz")
    print(f"base height {np.mean(heights):.4f} m on average, {min(heights):.4f} to {max(heights):.4f} m")
    tilt = np.degrees(np.arccos(min(1.0, robot.upright)))
    print(f"it ended {np.hypot(x, y):.3f} m from where it began, tilted by {tilt:.1f}°")
    print("it stood to the end" if fallen is None else f"it fell after {fallen:.2f} s")
    return int(fallen is not None)


if __name__ == "__main__":
    sys.exit(main())
