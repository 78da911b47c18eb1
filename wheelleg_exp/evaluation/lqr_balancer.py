"""A linear-quadratic balancer that acts through the task's own actions: the reference for learned policies.

Its gains follow from the compiled robot with its drives, and from one rule for the cost that holds for every robot.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import mujoco
import numpy as np
import torch
from scipy import linalg

from wheelleg_exp.anatomy.anatomy_parts import Anatomy
from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.actions import JointAction, JointEffortAction, JointPositionAction, JointVelocityAction
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.terrain.terrain_base import is_ground

Array = np.ndarray

# The LQR cost weights position, pitch, speed, and pitch rate in units of the pendulum's height and of gravity, and the
# input in units of the one that accelerates the axle with 1 g. The weights were chosen once for four robots: with a
# smaller weight of the input, a robot survives larger kicks, until it shakes on its soft legs.
_STATES = (3e-4, 1.0, 0.01, 0.1)
_INPUT = 0.06
_HEADING = 4.0  # gain, 1/s
_ACCELERATION = 0.04  # largest acceleration of the target speed, in g
# Limit the integrator's input to 0.05 rad, so that a push or a fall causes no integral windup.
_MOST_ERROR = 0.05
_NEAR = 2.0  # largest position error that counts, in heights of the pendulum, so that a kick causes no hurry
_LEAST_ANSWER = 1e-9  # least change of the speed, m/s, per change of the wheels' target, rad/s
_SETTLE_S = 0.5  # time in which the robot's weight comes to rest on its wheels and legs


class NoBalance(ConfigError):
    """A robot does not stand on one axle of driven wheels, so no controller of this module balances it."""


@dataclass(frozen=True)
class Pendulum:
    """Pendulum model of a robot on one axle of wheels: a rigid body at the default pose.

    ``mass``, kg, and ``inertia`` about the axle, kg·m², do not include the wheels. ``height`` is the distance of the
    centre of mass from the axle, m. ``lean`` is the pitch at which it is above the axle, rad, positive for nose down.
    ``rolling``, kg, is the wheels' mass plus their inertia over the radius squared. ``radius`` (wheels) and ``track``
    (distance of the outermost wheel contacts) are in m, ``gravity`` is in m/s².
    """

    mass: float
    height: float
    lean: float
    inertia: float
    rolling: float
    radius: float
    track: float
    gravity: float

    @property
    def pole(self) -> float:
        """The unstable pole of the pendulum model, 1/s, at a constant wheel speed relative to the body."""
        return math.sqrt(self.fall)

    @property
    def fall(self) -> float:
        """The pitch acceleration per radian of pitch, 1/s², at a constant wheel speed relative to the body."""
        return self.mass * self.gravity * self.height / self._inertia

    @property
    def tilt(self) -> float:
        """The pitch acceleration per wheel acceleration relative to the body; both in rad/s²."""
        return -self._coupling * self.radius / self._inertia

    @property
    def _coupling(self) -> float:
        """The coefficient, kg·m, that couples the pitch acceleration with the rolling of body and wheels."""
        return self.mass * self.height + (self.mass + self.rolling) * self.radius

    @property
    def _inertia(self) -> float:
        """The pitch inertia of the robot while the wheels turn with the body, kg·m².

        With pitch θ, axle speed v, and wheel torque τ, the body's equation is ``inertia·θ'' + mass·height·v' =
        mass·gravity·height·θ - τ``. The wheels' equation is ``(mass + rolling)·v' + mass·height·θ'' = τ / radius``.
        The axle speed is ``radius·(w + θ')`` with the pitch rate θ' and the wheel speed w relative to the body.
        """
        return self.inertia + self.mass * self.height * self.radius + self._coupling * self.radius


def pendulum_of(env: Env) -> tuple[Pendulum, Anatomy]:
    """Return a robot's pendulum model in the default pose and its anatomy; ConfigError unless it stands on one axle."""
    robot, model = env.scene.robot, env.scene.model
    data = at_default(model, robot)
    driven = [name for actuator in robot.actuators.values() for name in actuator.joint_names]
    anatomy = anatomy_of(model, data.qpos, driven)
    wheels = [wheel for wheel in anatomy.standing if wheel.driven and wheel.sign]
    if not wheels or len(wheels) < len(anatomy.standing) or not anatomy.one_axle or anatomy.forward is None:
        message = "the reference controller can only balance a robot on one axle of driven wheels"
        raise NoBalance(message, key="env.robot", expected="no reference for this robot: evaluate the policy alone")
    base = data.xmat[model.body(anatomy.base).id].reshape(3, 3)
    forward, up = (base @ np.array(axis) for axis in (anatomy.forward, anatomy.up))
    left = np.cross(up, forward)
    turned = {model.body(name).id for wheel in wheels for name in wheel.bodies}
    bodies = [int(body) for body in robot.body_ids if int(body) not in turned]
    axle = np.mean([data.xanchor[model.joint(wheel.joint).id] for wheel in wheels], axis=0)
    mass = model.body_mass[bodies]
    arm = mass @ data.xipos[bodies] / mass.sum() - axle
    radius = float(np.mean([wheel.radius for wheel in wheels]))
    rolling = sum(_inertia(model, data, {model.body(name).id for name in w.bodies}, left, None) for w in wheels)
    pendulum = Pendulum(
        mass=float(mass.sum()),
        height=float(np.hypot(arm @ forward, arm @ up)),
        lean=float(-math.atan2(arm @ forward, arm @ up)),
        inertia=_inertia(model, data, set(bodies), left, axle),
        rolling=float(model.body_mass[sorted(turned)].sum()) + rolling / radius**2,
        radius=radius,
        track=anatomy.support_width,
        gravity=float(np.linalg.norm(model.opt.gravity)),
    )
    return pendulum, anatomy


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, bodies: set[int], axis: Array, point: Array | None) -> float:
    """Return the sum of the bodies' inertias, kg·m², about an axis through ``point`` or each body's centre of mass."""
    total = 0.0
    for body in bodies:
        along = data.ximat[body].reshape(3, 3).T @ axis
        total += float(along @ (model.body_inertia[body] * along))
        if point is not None:
            arm = data.xipos[body] - point
            total += float(model.body_mass[body] * (arm @ arm - (arm @ axis) ** 2))
    return total


class Plant:
    """The compiled robot with its drives on level ground: how its balanced pose answers small changes.

    The state is [position, pitch, speed, pitch rate] of axle and body, in m and rad. The input is the target of the
    wheels' speed minus their speed at the start of a control step, rad/s.
    """

    def __init__(self, env: Env, pendulum: Pendulum, anatomy: Anatomy) -> None:
        robot, wheels = env.scene.robot, anatomy.standing
        self._model = model = _on_level_ground(env.scene.model)
        self._data = at_default(model, robot)
        self._steps = round(env.step_dt / model.opt.timestep)
        self._radius, self._signs = pendulum.radius, np.array([float(wheel.sign) for wheel in wheels])
        free = model.body_jntadr[model.body(anatomy.base).id]
        first, of_speed = int(model.jnt_qposadr[free]), int(model.jnt_dofadr[free])
        self._place, self._turned = slice(first, first + 3), slice(first + 3, first + 7)
        self._speed, self._rate = slice(of_speed, of_speed + 3), slice(of_speed + 3, of_speed + 6)
        self._joints = [model.joint(wheel.joint).id for wheel in wheels]
        self._angles, self._spins = model.jnt_qposadr[self._joints], model.jnt_dofadr[self._joints]
        # Each drive: its actuator, position and speed in the state, kp, kd, largest torque, default position, and
        # whether MuJoCo's solver does not compute its feedback.
        limits, defaults = (
            value[0].tolist() for value in (robot.data.joint_effort_limits, robot.data.default_joint_pos)
        )
        gains = [value[0].tolist() for value in (robot.data.default_joint_stiffness, robot.data.default_joint_damping)]
        self._drives = []
        for actuator in robot.actuators.values():
            for name, index in zip(actuator.joint_names, actuator.joint_ids.tolist(), strict=True):
                joint, own = model.joint(name), (*(gain[index] for gain in gains), limits[index], defaults[index])
                if not math.isfinite(own[0] + own[1]):
                    raise _unusable(f"the drive of '{name}' has no stiffness and damping")
                place = (model.actuator(name).id, joint.id, int(joint.qposadr[0]), int(joint.dofadr[0]))
                self._drives.append((*place, *own, actuator.reads_state))
        self._axis = np.array(anatomy.forward)
        frame = self._data.xmat[model.body(anatomy.base).id].reshape(3, 3)
        self._forward, self._up = frame @ self._axis, frame @ np.array(anatomy.up)
        self._left = np.cross(self._up, self._forward)
        self._turn(pendulum.lean)
        self._data.qpos[self._place] -= (self._axle() @ self._up - pendulum.radius) * self._up
        turned = self._data.qpos[self._turned].copy()
        for _ in range(round(_SETTLE_S / model.opt.timestep)):
            self._step(0.0 * self._signs)
            self._data.qpos[self._turned], self._data.qvel[self._rate] = turned, 0.0
        self._pose = self._data.qpos.copy()

    def linear(self) -> tuple[Array, Array]:
        """Return the matrices A (4, 4) and B (4, 1) of one control step, from central differences."""
        columns = [np.array([1.0, 0.0, 0.0, 0.0])]  # Nothing depends on the position.
        for change in np.diag((1e-3, 1e-2, 1e-2, 1e-1)):
            columns.append((self._after(change) - self._after(-change)) / (2.0 * change.max()))
        if not np.isfinite(columns).all() or abs(columns[4][2]) < _LEAST_ANSWER:
            raise _unusable("the robot's speed does not follow its wheel drives")
        return np.stack(columns[:4], axis=1), columns[4][:, None]

    def _after(self, change: Array) -> Array:
        """Return the state one control step after a change of pitch, speed, pitch rate, and input, (4,)."""
        data, (pitch, speed, rate, offset) = self._data, change
        mujoco.mj_resetData(self._model, data)
        data.qpos[:] = self._pose
        self._turn(pitch)
        turning = rate * self._left
        data.qvel[self._speed] = speed * self._forward + np.cross(turning, data.qpos[self._place] - self._axle())
        data.qvel[self._rate] = self._frame().T @ turning
        data.qvel[self._spins] = self._signs * (speed / self._radius - rate)
        target = data.qvel[self._spins] + self._signs * offset
        for _ in range(self._steps):
            self._step(target)
        frame = self._frame()
        pitch, rate = -math.asin(frame @ self._axis @ self._up), frame @ data.qvel[self._rate] @ self._left
        rolled, rolling = (float((v * self._signs).mean()) for v in (data.qpos[self._angles], data.qvel[self._spins]))
        return np.array([(rolled + pitch) * self._radius, pitch, (rolling + rate) * self._radius, rate])

    def _step(self, wheel_speeds: Array) -> None:
        """Simulate a physics step in which the drives hold the default pose and turn the wheels at target speeds."""
        data, speeds = self._data, dict(zip(self._joints, wheel_speeds, strict=True))
        for actuator, joint, at, moves, kp, kd, most, default, reads_state in self._drives:
            torque = kp * default + kd * speeds.get(joint, 0.0)
            if reads_state:
                torque = np.clip(torque - kp * data.qpos[at] - kd * data.qvel[moves], -most, most)
            data.ctrl[actuator] = torque
        mujoco.mj_step(self._model, data)

    def _turn(self, pitch: float) -> None:
        """Turn the body about the axle by a pitch, rad; the wheels do not turn."""
        data, about, turn, turned, moved = self._data, self._axle(), np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_axisAngle2Quat(turn, self._left, pitch)
        mujoco.mju_rotVecQuat(moved, data.qpos[self._place] - about, turn)
        mujoco.mju_mulQuat(turned, turn, data.qpos[self._turned])
        data.qpos[self._place], data.qpos[self._turned] = about + moved, turned
        data.qpos[self._angles] -= self._signs * pitch

    def _axle(self) -> Array:
        """Return the middle of the wheels' axes, m, (3,)."""
        mujoco.mj_kinematics(self._model, self._data)
        return np.asarray(self._data.xanchor[self._joints].mean(axis=0))

    def _frame(self) -> Array:
        """Return the axes of the base in the world, (3, 3)."""
        frame = np.zeros(9)
        mujoco.mju_quat2Mat(frame, self._data.qpos[self._turned])
        return frame.reshape(3, 3)


def _on_level_ground(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a scene's model in which the ground is a plane at height 0."""
    model = copy.copy(model)
    first, *others = (geom for geom in range(model.ngeom) if is_ground(model.geom(geom).name))
    model.geom_contype[others] = model.geom_conaffinity[others] = 0
    model.geom_type[first], model.geom_rbound[first], model.geom_sameframe[first] = mujoco.mjtGeom.mjGEOM_PLANE, 0.0, 0
    model.geom_pos[first], model.geom_quat[first], model.geom_size[first] = 0.0, (1, 0, 0, 0), (0, 0, 1)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # Its boxes are those of the former ground.
    return model


def _unusable(message: str) -> ConfigError:
    return ConfigError(message, key="env.robot.actuators", expected="drives with stiffness and damping")


class Reference:
    """An LQR balancer that is called like a policy, and returns the task's actions.

    It reads pitch and pitch rate from the IMU with its tilt and bias, but without noise, and the exact position and
    velocity.

    The target of a wheel is its speed plus u, the optimal input of the compiled robot (``Plant``). A speed difference
    between left and right wheels turns the robot to the commanded heading. All other joints stay at their default
    positions. The target speed follows the command with a limited acceleration, for which pitch and input are fed
    forward; the target position moves at this speed.

    An integrator with the time constant of the robot's unstable pole estimates the pitch at which the robot balances,
    which depends on the centre of mass, external forces, and the slope. Its input is the difference between the
    measured pitch acceleration and the pendulum model's prediction. The input is zero in balance, so that the position
    has no steady-state error, and while a drive is at its limit.
    """

    name = "reference"

    def __init__(self, env: Env, command: str = "base_velocity") -> None:
        self.pendulum, anatomy = pendulum_of(env)
        wheels = anatomy.standing
        self._env, device, robot = env, env.device, env.scene.robot
        self._command = env.command_manager.get_term(command)
        names = [wheel.joint for wheel in wheels]
        self._terms = _terms(env, names)
        ids = [robot.joint_names.index(name) for name in names]
        self._wheels = torch.tensor(ids, device=device)
        self._signs = torch.tensor([float(wheel.sign) for wheel in wheels], device=device)
        # In a left turn, left wheels get a negative speed change and right wheels get a positive speed change.
        sides = {"left": -1.0, "right": 1.0, "middle": 0.0}
        self._sides = torch.tensor([sides[wheel.side] for wheel in wheels], device=device)
        # The largest input that a wheel's drive does not clip, rad/s.
        self._most = float((robot.data.joint_effort_limits[0, ids] / robot.data.default_joint_damping[0, ids]).mean())
        a, b = Plant(env, self.pendulum, anatomy).linear()
        self.gains = _gains(a, b, self.pendulum, env.step_dt)
        self._k = torch.tensor(self.gains, dtype=torch.float32, device=device)
        # Pitch, rad, and input, rad/s, per acceleration: the pitch rate stays, and the speed grows evenly.
        fed = np.linalg.solve([[a[2, 1], b[2, 0]], [a[3, 1], b[3, 0]]], [env.step_dt, 0.0])
        self._fed_pitch, self._fed_input = fed.tolist()
        self._forward = torch.tensor(anatomy.forward, dtype=torch.float32, device=device)
        self._up = torch.tensor(anatomy.up, dtype=torch.float32, device=device)
        self._left = torch.linalg.cross(self._up, self._forward)
        self._place, self._heading, self._lean, self._speed = torch.zeros(4, env.num_envs, device=device).unbind()
        self._before = torch.zeros(3, env.num_envs, device=device)
        self._is_clipped = torch.zeros(env.num_envs, dtype=torch.bool, device=device)
        centres = np.mean([wheel.centre for wheel in wheels], axis=0)
        self._axle = torch.tensor(centres, dtype=torch.float32, device=device)
        self._axle_before = torch.zeros(env.num_envs, 3, device=device)

    def describe(self) -> dict[str, object]:
        """Return the pendulum model and the LQR gains as a dictionary for JSON."""
        model = {"pendulum": asdict(self.pendulum), "pole_per_s": self.pendulum.pole, "gains": self.gains.tolist()}
        return {**model, "integrator_per_s": self.pendulum.pole}

    def __call__(self, observations: Mapping[str, object] | None = None) -> torch.Tensor:
        """Return raw actions (N, A). The observations are not used."""
        del observations
        env, data, dt = self._env, self._env.scene.robot.data, self._env.step_dt
        gravity = data.projected_gravity_measured
        pitch = torch.atan2(gravity @ self._forward, -(gravity @ self._up))
        rate = data.root_ang_vel_measured @ self._left
        speed = (data.joint_vel[:, self._wheels] * self._signs).mean(dim=1)
        along = pitch.cos().unsqueeze(1) * self._forward + pitch.sin().unsqueeze(1) * self._up
        of_axle = data.root_link_lin_vel_b + torch.linalg.cross(data.root_ang_vel_b, self._axle.expand_as(along))
        velocity = (of_axle * along).sum(dim=1)
        yaw, fresh, turned = data.heading_w, env.episode_length_buf == 0, data.root_rot_w
        # Do not integrate the velocity: a kick between two steps would leave an error of half a step times its speed.
        axle = data.root_pos_w + rotation.rotate(turned, self._axle.expand_as(along))
        moved = ((axle - self._axle_before) * rotation.rotate(turned, along)).sum(dim=1)
        self._axle_before = axle
        self._place, self._speed = (torch.where(fresh, 0.0, value) for value in (self._place + moved, self._speed))
        self._heading = torch.where(fresh, yaw, self._heading)
        forward, turn = self._command.command[:, 0], self._command.command[:, 2]
        most = _ACCELERATION * self.pendulum.gravity * dt
        change = (forward - self._speed).clamp(-most, most)
        self._speed = self._speed + change
        lean = self._balance(fresh, torch.stack((pitch, rate, speed))) + change / dt * self._fed_pitch
        near = self._place.clamp(-_NEAR * self.pendulum.height, _NEAR * self.pendulum.height)
        error = torch.stack((near, pitch - lean, velocity - self._speed, rate), dim=1)
        wheel = speed + change / dt * self._fed_input - error @ self._k
        self._is_clipped = (wheel - speed).abs() > self._most
        # Wrap the heading error to ±π, so that the robot turns by the smaller angle.
        off = torch.remainder(self._heading - yaw + math.pi, 2 * math.pi) - math.pi
        spin = (turn + _HEADING * off) * self.pendulum.track / (2 * self.pendulum.radius)
        targets = (wheel.unsqueeze(1) + spin.unsqueeze(1) * self._sides) * self._signs
        self._place = self._place - self._speed * dt
        self._heading = self._heading + turn * dt
        return self._actions(targets)

    def _balance(self, fresh: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Update and return the balanced pitch, rad, (N,); ``state`` (3, N) is pitch, pitch rate, and wheel speed."""
        dt = self._env.step_dt
        _, pitching, rolling = (state - self._before) / dt
        pitch = (state[0] + self._before[0]) / 2
        apparent = pitch - (pitching - self.pendulum.tilt * rolling) / self.pendulum.fall - self.pendulum.lean
        error = (apparent - self._lean).clamp(-_MOST_ERROR, _MOST_ERROR).masked_fill(self._is_clipped, 0.0)
        self._lean = torch.where(fresh, 0.0, self._lean + self.pendulum.pole * dt * error)
        self._before = state
        return self.pendulum.lean + self._lean

    def _actions(self, wheel_targets: torch.Tensor) -> torch.Tensor:
        """Return raw actions that set the given wheel speeds and keep all other joints at their default positions."""
        data = self._env.scene.robot.data
        limits = data.soft_joint_vel_limits[:, self._wheels]
        speeds = data.default_joint_vel.clone()
        speeds[:, self._wheels] = wheel_targets.clamp(-limits, limits)
        wanted = {"velocity": speeds, "position": data.default_joint_pos, "effort": torch.zeros_like(speeds)}
        return torch.cat([term.raw_for(wanted[term.drives][:, ids]) for term, ids in self._terms], dim=1)


def _gains(a: Array, b: Array, pendulum: Pendulum, step_dt: float) -> Array:
    """Return the LQR gains K (4,) of the feedback u = -K [position, pitch, speed, pitch rate] for a control step."""
    per_s = math.sqrt(pendulum.gravity / pendulum.height)
    units = np.array((pendulum.height, 1.0, pendulum.height * per_s, per_s))
    inputs = np.array([[_INPUT * (b[2, 0] / (pendulum.gravity * step_dt)) ** 2]])
    states = np.diag(_STATES / units**2)
    cost = linalg.solve_discrete_are(a, b, states, inputs)
    return np.asarray(np.linalg.solve(inputs + b.T @ cost @ b, b.T @ cost @ a)[0])


def _terms(env: Env, wheels: list[str]) -> list[tuple[JointAction, torch.Tensor]]:
    """Return the task's action terms and their joints. Raise ConfigError if no action term sets the wheels' speeds."""
    found: list[tuple[JointAction, torch.Tensor]] = []
    manager, names = env.action_manager, env.scene.robot.joint_names
    for name in manager.active_terms:
        term = manager.get_term(name)
        if not isinstance(term, (JointPositionAction, JointVelocityAction, JointEffortAction)):
            message = "the reference controller cannot compute this action from a joint target"
            expected = "actions that scale and offset: positions, velocities, efforts"
            raise ConfigError(message, key=f"env.actions.{name}", expected=expected)
        found.append((term, torch.tensor([names.index(joint) for joint in term.joint_names], device=env.device)))
    driven = {joint for term, _ in found if isinstance(term, JointVelocityAction) for joint in term.joint_names}
    if not set(wheels) <= driven:
        message = "the reference controller sets wheel speeds, but no action of the task does"
        raise ConfigError(message, key="env.actions", expected="a velocity action of " + ", ".join(wheels))
    return found
