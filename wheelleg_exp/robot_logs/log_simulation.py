"""Simulate a run's robot with the targets of a log, and compare the simulated motion with the log's readings.

The simulation starts again from the log's readings every 0.1 s, because a balancing robot diverges. A log has no
readings of the base's height and linear velocity: the wheels stand on level ground and roll without slip.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
import torch

from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.managers import SceneManager
from wheelleg_exp.robot_logs.robot_log import TARGETS, Numbers, RobotLog
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.options import read_env

WINDOW_S, MOST_LAG = 0.1, 6  # MOST_LAG is the longest delay that is tried, in rows.
_LANDING_S = 1.0  # s; the start of an episode that windows leave out
_PLANE = "wheelleg_exp.sim.terrain.Plane"
_FRICTION = ("static_friction", "dynamic_friction", "restitution")


def channels(joint_names: Sequence[str]) -> list[str]:
    """Return the log's columns that a simulation predicts, C = 2 J + 6: joints, gyroscope, and gravity."""
    joints = [f"{reading}.{name}" for reading in ("joint_pos", "joint_vel") for name in joint_names]
    return joints + [f"{reading}.{axis}" for reading in ("base_ang_vel", "projected_gravity") for axis in "xyz"]


@dataclass(frozen=True)
class Sensing:
    """N models of how a log shows the robot: logged[k] = matrix @ true[k - lag] + offset, and gains of the drives.

    ``matrix`` (N, C, C), ``offset`` (N, C), ``lag`` (N, C) in rows, ``gain`` (N, J) on stiffness and damping.
    """

    matrix: Numbers
    offset: Numbers
    lag: np.ndarray
    gain: Numbers

    @classmethod
    def identity(cls, count: int, width: int, joints: int) -> Sensing:
        """Return ``count`` models of faultless readings and drives."""
        eye = np.broadcast_to(np.eye(width), (count, width, width)).copy()
        lag = np.zeros((count, width), dtype=np.int64)
        return cls(eye, np.zeros((count, width)), lag, np.ones((count, joints)))

    def after(self, first: Sensing) -> Sensing:
        """Return the models that apply ``first`` (one model), then these models."""
        matrix = self.matrix @ first.matrix
        offset = (self.matrix @ first.offset[..., None])[..., 0] + self.offset
        lag = np.minimum(self.lag + first.lag, MOST_LAG)
        return Sensing(matrix, offset, lag, self.gain * first.gain)

    def true_values(self, logged: Numbers, rows: np.ndarray) -> Numbers:
        """Return the true values of logged readings (T, C) in ``rows`` (R,), as each model explains them, (N, R, C)."""
        seen = _later(logged, rows, self.lag) - self.offset[:, None]
        return np.asarray(np.einsum("nij,nrj->nri", np.linalg.inv(self.matrix), seen))

    def errors(self, logged: Numbers, rows: np.ndarray, true: Numbers) -> Numbers:
        """Return the logged readings in ``rows`` (R,) minus the readings that the models make of ``true`` (N, R, C)."""
        shown = np.einsum("nij,nrj->nri", self.matrix, true) + self.offset[:, None]
        return np.asarray(_later(logged, rows, self.lag) - shown)


def _later(logged: Numbers, rows: np.ndarray, lag: np.ndarray) -> Numbers:
    later = np.minimum(rows[None, :, None] + lag[:, None, :], len(logged) - 1)
    return np.take_along_axis(logged[None], later, axis=1)


@contextmanager
def _silent() -> Iterator[None]:
    """Silence MuJoCo's warnings: a wrong explanation of a log can make a simulation unstable."""
    config = mujoco.MjLogConfig.get()
    before, config.logto_console = config.logto_console, False
    config.set()
    try:
        yield
    finally:
        config.logto_console = before
        config.set()


class LogSimulation:
    """N simulations of the robot of a run's ``env`` config on level ground; a control step takes ``step_dt``, s."""

    def __init__(self, params: Mapping[str, object], mjcf: Path, num_envs: int, step_dt: float) -> None:
        env = read_env(params)
        self.decimation = env.decimation
        ground = {name: env.scene.terrain[name] for name in _FRICTION if name in env.scene.terrain}
        scene = replace(env.scene, terrain={"_target_": _PLANE, **ground}, sensors={})
        env = replace(env, scene=scene, sim=replace(env.sim, dt=step_dt / env.decimation))
        self.scene = SceneManager(env, mjcf, num_envs).scene
        self.scene.play()
        self.robot, self.sim = self.scene.robot, self.scene.sim
        self.step_dt = self.scene.physics_dt * self.decimation
        self.length = max(2, round(WINDOW_S / self.step_dt))
        wheels = anatomy_of(self.sim.model, at_default(self.sim.model, self.robot).qpos).wheels
        self._wheels = [self.robot.body_names.index(wheel.body) for wheel in wheels]
        self._radii = torch.tensor([wheel.radius for wheel in wheels], dtype=torch.float32)
        self._gains = [getattr(self.robot.data, f"joint_{name}").clone() for name in ("stiffness", "damping")]

    def windows(self, log: RobotLog, most: int) -> np.ndarray:
        """Return the first rows (W,) of at most ``most`` windows without gaps and resets: those with most motion."""
        logged, length = log.table(channels(self.robot.joint_names)), self.length
        # A robot that lands after a reset has contacts that the simulated windows lack.
        started = np.convolve(log.starts(self.step_dt), np.ones(round(_LANDING_S / self.step_dt)))[: len(log)] > 0
        broken = started | ~log.accepted
        ends = np.arange(length, len(log) - MOST_LAG, length)
        whole = [end for end in ends if not broken[end - length + 1 : end + MOST_LAG].any()]
        starts = [end - length for end in whole if np.isfinite(logged[end - length : end + MOST_LAG]).all()]
        rows = np.array(starts, int)
        motion = np.abs(logged[rows + length] - logged[rows]) / np.maximum(logged.std(axis=0), 1e-9)
        return np.sort(rows[np.argsort(-motion.sum(axis=1))[:most]])

    def errors(self, log: RobotLog, sensing: Sensing, starts: np.ndarray) -> Numbers:
        """Return logged minus predicted readings of M models in W windows from the rows ``starts``, (M, W, rows, C)."""
        names, count, width = self.robot.joint_names, len(sensing.lag), self.scene.num_envs
        logged = log.table(channels(names))
        states = torch.from_numpy(sensing.true_values(logged, starts)).flatten(0, 1)
        targets = torch.from_numpy(np.stack([log.targets(kind, names) for kind in TARGETS], axis=1)).float()
        rows = torch.from_numpy(starts).repeat(count)
        gain = torch.from_numpy(sensing.gain).float().repeat_interleave(len(starts), dim=0)
        found = torch.empty(self.length, len(rows), states.shape[1], dtype=torch.float64)
        with _silent():
            for first in range(0, len(rows), width):
                part = torch.arange(first, first + width).clamp(max=len(rows) - 1)
                found[:, part] = self._predicted(states[part], gain[part], targets, rows[part])
        true = found.reshape(self.length, count, len(starts), -1).permute(1, 2, 0, 3).numpy()
        later = (starts[:, None] + np.arange(1, self.length + 1)).ravel()
        errors = sensing.errors(logged, later, true.reshape(count, len(later), -1))
        return errors.reshape(true.shape)

    def _predicted(
        self, states: torch.Tensor, gain: torch.Tensor, targets: torch.Tensor, rows: torch.Tensor
    ) -> torch.Tensor:
        robot, found = self.robot, []
        robot.write_joint_stiffness_to_sim(self._gains[0] * gain)
        robot.write_joint_damping_to_sim(self._gains[1] * gain)
        robot.reset()
        self._write(states)
        for step in range(self.length):
            robot.begin_control_step()
            position, velocity, effort = targets[rows + step].unbind(dim=1)
            robot.set_joint_position_target(position)
            robot.set_joint_velocity_target(velocity)
            robot.set_joint_effort_target(effort)
            for _ in range(self.decimation):
                self.scene.write_data_to_sim()
                self.sim.step()
                self.scene.update()
            found.append(self._read())
        return torch.stack(found)

    def _write(self, state: torch.Tensor) -> None:
        """Write true readings (N, C) to the simulations, with the wheels on the ground and rolling without slip."""
        robot, joints = self.robot, len(self.robot.joint_names)
        qpos, qvel = self.sim.view("qpos"), self.sim.view("qvel")
        gravity = torch.nn.functional.normalize(state[:, -3:], dim=1)
        roll, pitch = torch.atan2(-gravity[:, 1], -gravity[:, 2]), torch.asin(gravity[:, 0].clamp(-1, 1))
        qpos[:, :7] = robot.data.default_root_state[:, :7].double()
        qpos[:, 3:7] = rotation.quat_from_euler_xyz(roll, pitch, torch.zeros_like(roll))
        qvel[:, :3] = 0.0
        qvel[:, 3:6] = state[:, 2 * joints : 2 * joints + 3]
        qpos[:, robot.layout.qpos_ids] = state[:, :joints]
        qvel[:, robot.layout.dof_ids] = state[:, joints : 2 * joints]
        robot.mark_written(robot._all_ids)
        self.scene.refresh()
        data, wheels = robot.data, self._wheels
        down = torch.zeros(3).index_fill(0, torch.tensor(2), -1.0) * self._radii.unsqueeze(1)
        spin = torch.linalg.cross(data.body_ang_vel_w[:, wheels], down.expand(len(state), -1, -1))
        qvel[:, :3] = -(data.body_link_lin_vel_w[:, wheels] + spin).mean(dim=1).double()
        qpos[:, 2] += (self._radii - data.body_pos_w[:, wheels, 2]).mean(dim=1)
        robot.mark_written(robot._all_ids)
        self.scene.refresh()

    def _read(self) -> torch.Tensor:
        data, qpos, qvel = self.robot.data, self.sim.view("qpos"), self.sim.view("qvel")
        joints = qpos[:, self.robot.layout.qpos_ids], qvel[:, self.robot.layout.dof_ids]
        return torch.cat((*joints, qvel[:, 3:6], data.projected_gravity_b.double()), dim=1)
