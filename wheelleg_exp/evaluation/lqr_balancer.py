"""A linear-quadratic balancer that acts through the task's own actions: the reference for learned policies."""

from __future__ import annotations

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

Array = np.ndarray

# `_STATES` weights position, pitch, speed, and pitch rate in the LQR cost; `_INPUT` weights the wheel acceleration.
_STATES = (200.0, 400.0, 20.0, 4.0)
_INPUT = 1e-3
_HEADING = 4.0  # gain, 1/s
# Limit the integrator's input to 0.05 rad, so that a push or a fall causes no integral windup.
_MOST_ERROR = 0.05


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
        return math.sqrt(self.mass * self.gravity * self.height / self._inertia)

    @property
    def _coupling(self) -> float:
        """The coefficient, kg·m, that couples the pitch acceleration with the rolling of body and wheels."""
        return self.mass * self.height + (self.mass + self.rolling) * self.radius

    @property
    def _inertia(self) -> float:
        """The pitch inertia of the robot while the wheels turn with the body, kg·m²."""
        return self.inertia + self.mass * self.height * self.radius + self._coupling * self.radius

    def linear(self) -> tuple[Array, Array]:
        """Return the matrices A (4, 4) and B (4, 1) of the model with the state [position, pitch, speed, pitch rate].

        The pendulum model is linearised at the balanced pitch. The input u is the acceleration of the wheels relative
        to the body, so the model does not need the motors' armature. With pitch θ, axle speed v, and wheel torque τ,
        the body's equation is ``inertia·θ'' + mass·height·v' = mass·gravity·height·θ - τ``. The wheels' equation is
        ``(mass + rolling)·v' + mass·height·θ'' = τ / radius``. The axle speed is ``radius·(w + θ')`` with the pitch
        rate θ' and the wheel speed w relative to the body.
        """
        falls = self.mass * self.gravity * self.height / self._inertia
        tilts = -self._coupling * self.radius / self._inertia
        r = self.radius
        a = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [0, r * falls, 0, 0], [0, falls, 0, 0]], dtype=np.float64)
        b = np.array([[0], [0], [r * (1 + tilts)], [tilts]], dtype=np.float64)
        return a, b

    def gains(self, step_dt: float) -> Array:
        """Return the LQR gains K (4,) of the feedback u = -K [position, pitch, speed, pitch rate] in discrete time."""
        a, b = self.linear()
        # The upper rows of the matrix exponential contain the discrete-time matrices A and B (zero-order hold).
        whole = linalg.expm(np.block([[a, b], [np.zeros((1, 5))]]) * step_dt)
        a, b = whole[:4, :4], whole[:4, 4:]
        cost = linalg.solve_discrete_are(a, b, np.diag(_STATES), np.array([[_INPUT]]))
        return np.asarray(np.linalg.solve(_INPUT + b.T @ cost @ b, b.T @ cost @ a)[0])


def pendulum_of(env: Env) -> tuple[Pendulum, Anatomy]:
    """Return a robot's pendulum model in the default pose and its anatomy; ConfigError unless it stands on one axle."""
    robot, model = env.scene.robot, env.scene.model
    data = at_default(model, robot)
    driven = [name for actuator in robot.actuators.values() for name in actuator.joint_names]
    anatomy = anatomy_of(model, data.qpos, driven)
    wheels = [wheel for wheel in anatomy.standing if wheel.driven and wheel.sign]
    if not wheels or len(wheels) < len(anatomy.standing) or not anatomy.one_axle or anatomy.forward is None:
        message = "the reference controller can only balance a robot on one axle of driven wheels"
        raise ConfigError(message, key="env.robot", expected="no reference for this robot: evaluate the policy alone")
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


class Reference:
    """An LQR balancer that is called like a policy, reads the state without noise, and returns the task's actions.

    The target of a wheel is ``w + u / b``: its speed w, the optimal acceleration u, and the ``bandwidth`` b of its
    drive in 1/s. A speed difference between left and right wheels turns the robot to the commanded heading. All other
    joints stay at their default positions. The target position of the robot moves at the commanded speed, so that the
    LQR corrects position errors.

    An integrator with the time constant of the robot's unstable pole estimates the pitch at which the robot balances,
    which depends on the centre of mass, external forces, and the slope. Its input is the difference between the
    measured pitch acceleration and the linear model's prediction. The input is zero in balance, so that the position
    has no steady-state error, and velocity commands cause no windup.
    """

    name = "reference"

    def __init__(self, env: Env, command: str = "base_velocity") -> None:
        self.pendulum, anatomy = pendulum_of(env)
        wheels = anatomy.standing
        self._env, device, robot = env, env.device, env.scene.robot
        self._command = env.command_manager.get_term(command)
        self.gains = self.pendulum.gains(env.step_dt)
        self._k = torch.tensor(self.gains, dtype=torch.float32, device=device)
        names = [wheel.joint for wheel in wheels]
        ids = [robot.joint_names.index(name) for name in names]
        self._wheels = torch.tensor(ids, device=device)
        self._signs = torch.tensor([float(wheel.sign) for wheel in wheels], device=device)
        # In a left turn, left wheels get a negative speed change and right wheels get a positive speed change.
        sides = {"left": -1.0, "right": 1.0, "middle": 0.0}
        self._sides = torch.tensor([sides[wheel.side] for wheel in wheels], device=device)
        # A wheel drive's bandwidth, 1/s, is its damping divided by its armature, but at most the control frequency.
        damping = robot.data.default_joint_damping[0, ids].mean()
        armature = robot.data.default_joint_armature[0, ids].mean()
        most = 1.0 / env.step_dt
        self.bandwidth = most if armature <= 0.0 else min(float(damping / armature), most)
        self._forward = torch.tensor(anatomy.forward, dtype=torch.float32, device=device)
        self._up = torch.tensor(anatomy.up, dtype=torch.float32, device=device)
        self._left = torch.linalg.cross(self._up, self._forward)
        self._terms = _terms(env, names)
        self._place, self._heading, self._lean = torch.zeros(3, env.num_envs, device=device).unbind()
        self._before = torch.zeros(3, env.num_envs, device=device)

    def describe(self) -> dict[str, object]:
        """Return the pendulum model and the LQR gains as a dictionary for JSON."""
        model = {"pendulum": asdict(self.pendulum), "pole_per_s": self.pendulum.pole, "gains": self.gains.tolist()}
        return {**model, "integrator_per_s": self.pendulum.pole, "bandwidth_per_s": self.bandwidth}

    def __call__(self, observations: Mapping[str, object] | None = None) -> torch.Tensor:
        """Return raw actions (N, A). The observations are not used."""
        del observations
        env, data = self._env, self._env.scene.robot.data
        gravity = data.projected_gravity_measured
        pitch = torch.atan2(gravity @ self._forward, -(gravity @ self._up))
        rate = data.root_ang_vel_measured @ self._left
        turned = (data.joint_pos_measured[:, self._wheels] * self._signs).mean(dim=1)
        speed = (data.joint_vel[:, self._wheels] * self._signs).mean(dim=1)
        place, velocity = (turned + pitch) * self.pendulum.radius, (speed + rate) * self.pendulum.radius
        yaw = data.heading_w
        fresh = env.episode_length_buf == 0
        self._place = torch.where(fresh, place, self._place)
        self._heading = torch.where(fresh, yaw, self._heading)
        lean = self._balance(fresh, torch.stack((pitch, rate, speed)))
        forward, turn = self._command.command[:, 0], self._command.command[:, 2]
        error = torch.stack((place - self._place, pitch - lean, velocity - forward, rate), dim=1)
        wheel = speed - (error @ self._k) / self.bandwidth
        # Wrap the heading error to ±π, so that the robot turns by the smaller angle.
        off = torch.remainder(self._heading - yaw + math.pi, 2 * math.pi) - math.pi
        spin = (turn + _HEADING * off) * self.pendulum.track / (2 * self.pendulum.radius)
        targets = (wheel.unsqueeze(1) + spin.unsqueeze(1) * self._sides) * self._signs
        self._place = self._place + forward * env.step_dt
        self._heading = self._heading + turn * env.step_dt
        return self._actions(targets)

    def _balance(self, fresh: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Update and return the balanced pitch, rad, (N,); ``state`` (3, N) is pitch, pitch rate, and wheel speed."""
        a, b = (matrix.tolist() for matrix in self.pendulum.linear())
        dt = self._env.step_dt
        _, pitching, rolling = (state - self._before) / dt
        pitch = (state[0] + self._before[0]) / 2
        apparent = pitch - (pitching - b[3][0] * rolling) / a[3][1] - self.pendulum.lean
        error = (apparent - self._lean).clamp(-_MOST_ERROR, _MOST_ERROR)
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
