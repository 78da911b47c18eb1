"""Solve for the pose in which a wheeled robot stands: balanced, symmetric, at a sensible height."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from wheelleg_exp.anatomy.anatomy_parts import Anatomy
from wheelleg_exp.anatomy.collider_shapes import lowest_point, overlap_depths
from wheelleg_exp.anatomy.compiled_robot import CompiledRobot, with_written_limits

Array = NDArray[np.float64]

_STARTS = 10  # The search for a standing pose starts from the given pose and from ten random poses.
_STEPS = 40  # iterations from each start
_MARGIN = 0.08  # In a standing pose, each joint is at least 8 % of its range away from its limits.
# Legs count as stretched above 93 % of the largest hip height, and as crouched below 35 % of this height.
_STRETCHED, _CROUCHED = 0.93, 0.35
# Stretched legs are moved to 80 % of the largest hip height, and crouched legs to 55 % of this height.
_STANDS = (0.8, 0.55)
_CLEARANCE = 0.5  # All bodies except wheels should be at least half a wheel radius above the ground.
_REACH = math.pi  # The search for a standing pose rotates a joint without limits by at most pi rad.
_BALANCED = 5e-3  # In a balanced pose, the centre of mass is above the axle, up to 0.5 % of the robot's size.
_TOUCHES = 2e-3  # A wheel touches the ground if it is at most 0.2 % of the robot's size higher than the lowest wheel.
_EQUALITY = int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)


@dataclass(frozen=True)
class Stance:
    """A standing pose of a robot: joint positions, height, balance, and ground contact."""

    positions: dict[str, float]  # positions of the leg joints by joint name, in rad (slide joints: m)
    height: float  # mean height of the hips above the wheels, m; ``tallest`` is the largest possible ``height``
    offset: float  # the distance by which the centre of mass is in front of the middle of the wheel contacts, m
    # ``lean`` is the base pitch that balances the robot, rad, positive if the front is down; 0 for several axles.
    lean: float
    tallest: float
    balanced: bool  # whether the robot's centre of mass is above the middle of the wheels' contact points
    grounded: bool  # whether all wheels that should carry the robot touch level ground


def solve_stance(model: mujoco.MjModel, anatomy: Anatomy, qpos: Sequence[float] | Array) -> Stance | None:
    """Find a robot's standing pose near a given pose; None if the robot has no parallel wheel axles.

    The base keeps its orientation in ``qpos``, and only leg joints move. Without them, the stance of a robot on one
    axle contains its lean, and is None for several axles. ``mujoco.minimize`` solves a least-squares problem from
    several starts. If possible, all wheels touch the ground; otherwise, those that do in ``qpos``.
    """
    if anatomy.forward is None:
        return None
    every = replace(anatomy, wheels=tuple(replace(wheel, stands=True) for wheel in anatomy.wheels))
    found = _solved(model, every, qpos)
    return found if found is None or found.grounded else _solved(model, anatomy, qpos)


def _solved(model: mujoco.MjModel, anatomy: Anatomy, qpos: Sequence[float] | Array) -> Stance | None:
    problem = _Problem(model, anatomy, np.array(qpos, dtype=np.float64))
    if not problem.hips:
        return problem.stance(problem.preferred) if not problem.joints and anatomy.one_axle else None
    problem.choose_height()
    starts = [problem.preferred, *problem.random_poses(_STARTS)]
    found = min((problem.search(start) for start in starts), key=problem.cost)
    return problem.stance(problem.tied(found))


class _Problem:
    """The least-squares problem: the cost of a pose as a function of the positions of the legs' joints."""

    def __init__(self, model: mujoco.MjModel, anatomy: Anatomy, qpos: Array) -> None:
        self.model, self.anatomy = model, anatomy
        self.data = mujoco.MjData(model)
        self.data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, self.data)
        named = dict.fromkeys(name for leg in anatomy.legs for name in (*leg.joints, *leg.beside))
        self.joints = [name for name in named if name not in anatomy.casters.union(anatomy.wheel_joints)]
        ids = [model.joint(name).id for name in self.joints]
        self.places = model.jnt_qposadr[ids]
        limited, now = model.jnt_limited[ids].astype(bool), self.data.qpos[self.places]
        low, high = model.jnt_range[ids].T
        margin = _MARGIN * (high - low)
        self.low = np.where(limited, low + margin, now - _REACH)
        self.high = np.where(limited, high - margin, now + _REACH)
        self.preferred = np.clip(self.data.qpos[self.places], self.low, self.high)
        self.spread = self.high - self.low
        self.base = model.body(anatomy.base).id
        self.bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] == model.body_rootid[self.base]]
        turned = {name for wheel in anatomy.standing for name in wheel.bodies}
        self.raised = [body for body in self.bodies if model.body(body).name not in turned]
        rotation = self.data.xmat[self.base].reshape(3, 3)
        self.forward, self.up = (rotation @ np.array(axis) for axis in (anatomy.forward or (1, 0, 0), anatomy.up))
        self.wheels = [model.body(wheel.body).id for wheel in anatomy.standing]
        # ``centres`` has the wheels' centres in the frames of the wheels' bodies, m.
        self.centres = [
            self.data.xmat[body].reshape(3, 3).T
            @ (self.data.xpos[self.base] + rotation @ np.array(wheel.centre) - self.data.xpos[body])
            for body, wheel in zip(self.wheels, anatomy.standing, strict=True)
        ]
        self.size = max(anatomy.size, 1e-6)
        self.radii = np.array([wheel.radius for wheel in anatomy.standing])
        self.radius = self.radii.min(initial=math.inf)
        self.one_axle = bool(np.ptp(self._centres() @ self.forward) < self.radius / 2)
        self.rolling = [model.joint(wheel.joint).id for wheel in anatomy.standing if not wheel.caster]
        stand = {wheel.joint for wheel in anatomy.standing}
        firsts = [leg.joints[0] for leg in anatomy.legs if leg.joints and leg.wheel in stand]
        self.hips = [model.joint(name).id for name in firsts if name in self.joints]
        # ``pairs`` lists the mirrored pairs of leg joints, each as two joint indices and a sign.
        index = {name: number for number, name in enumerate(self.joints)}
        pairs = [pair for pair in self.anatomy.mirrored if pair.left != pair.right]
        self.pairs = [(index[p.left], index[p.right], p.sign) for p in pairs if p.left in index and p.right in index]
        # In the standing pose, bodies may overlap as deeply as in the initial pose, but not more deeply.
        self.rest = overlap_depths(model, self.data, self.bodies)
        self.tallest = self.wanted = 0.0

    def at(self, positions: Array) -> mujoco.MjData:
        """Return MuJoCo's data of the robot in a pose, with computed contacts."""
        self.data.qpos[self.places] = positions
        mujoco.mj_fwdPosition(self.model, self.data)
        return self.data

    def _centres(self) -> Array:
        """Return the wheels' centres, m, (wheels, 3)."""
        data, placed = self.data, zip(self.wheels, self.centres, strict=True)
        return np.array([data.xpos[body] + data.xmat[body].reshape(3, 3) @ centre for body, centre in placed])

    def _height(self) -> float:
        """Return the height of the hips (first leg joints) above the wheels' centres, m."""
        if not self.hips:
            return 0.0
        hips = np.mean([self.data.xanchor[joint] for joint in self.hips], axis=0)
        return float((hips - self._centres().mean(axis=0)) @ self.up)

    def choose_height(self) -> None:
        """Choose the initial pose's hip height, or a default height if the initial pose stretches or folds the legs."""
        self.at(self.preferred)
        now = self._height()
        heights = []
        # The largest hip height in 400 random poses approximates the hip height of stretched legs, for any type of leg.
        for pose in self.random_poses(400):
            self.data.qpos[self.places] = pose
            mujoco.mj_kinematics(self.model, self.data)
            heights.append(self._height())
        self.tallest = max([now, *heights])
        share = now / self.tallest if self.tallest > 0 else 1.0
        factor = _STANDS[0] if share > _STRETCHED else _STANDS[1] if share < _CROUCHED else share
        self.wanted = factor * self.tallest

    def random_poses(self, count: int) -> list[Array]:
        """Return random mirror-symmetric leg poses within the joint limits."""
        poses = np.random.default_rng(0).uniform(self.low, self.high, (count, len(self.joints)))
        for left, right, sign in self.pairs:
            poses[:, right] = np.clip(sign * poses[:, left], self.low[right], self.high[right])
        return list(poses)

    def overlap(self) -> float:
        """Compare the overlap depth of each body pair with the initial pose; return the largest increase, m."""
        depths = overlap_depths(self.model, self.data, self.bodies)
        return max((depth - self.rest.get(pair, 0.0) for pair, depth in depths.items()), default=0.0)

    def offset(self) -> float:
        """Return the distance of the robot's centre of mass in front of the middle of the wheels, m."""
        places = self._centres() @ self.forward
        return float(self.data.subtree_com[self.base] @ self.forward - (places.max() + places.min()) / 2)

    def residual(self, positions: Array) -> Array:
        """Return a leg pose's weighted, dimensionless errors; the pose search minimises the sum of their squares."""
        data = self.at(positions)
        centres = self._centres()
        ground = (centres @ self.up).min() - self.radius
        low = -lowest_point(self.model, data, self.raised)
        low = ground + low if math.isfinite(low) else -math.inf
        loops = data.efc_pos[data.efc_type == _EQUALITY] if data.nefc else np.zeros(0)
        apart = [positions[right] - sign * positions[left] for left, right, sign in self.pairs]
        moved = (positions - self.preferred) / self.spread
        # Open kinematic loops cost most (weight 1000); changes of the initial pose cost least (weight 0.5).
        # A robot with several axles cannot fall, so its balance error has the weight 20 instead of 200.
        sides = [centres[[w.side == side for w in self.anatomy.standing]] for side in ("left", "right")]
        # ``askew`` is the distance by which the left wheels are in front of the right wheels, m.
        askew = float((sides[0].mean(axis=0) - sides[1].mean(axis=0)) @ self.forward) if all(map(len, sides)) else 0.0
        errors = [
            (200.0 if self.one_axle else 20.0) * self.offset() / self.size,
            100.0 * askew / self.size,
            *(500.0 * self._clearances(centres) / self.size),
            *(10.0 * (data.xaxis[self.rolling] @ np.array([self.up, self.forward]).T)).ravel(),
            *(1000.0 * loops / self.size),
            10.0 * (self._height() - self.wanted) / self.size,
            20.0 * max(0.0, low + _CLEARANCE * self.radius) / self.size,
            100.0 * self.overlap() / self.size,
            *(2.0 * np.array(apart)),
            *(0.5 * moved),
        ]
        return np.array(errors)

    def _clearances(self, centres: Array) -> Array:
        """Return how much higher each wheel's lowest point is than the average of all wheels, m, (wheels,)."""
        lows: Array = centres @ self.up - self.radii
        return np.asarray(lows - lows.mean())

    def cost(self, positions: Array) -> float:
        return float(np.square(self.residual(positions)).sum())

    def search(self, start: Array) -> Array:

        def columns(poses: Array) -> Array:
            return np.stack([self.residual(pose) for pose in poses.T], axis=1)

        found, _ = minimize.least_squares(
            start.copy(), columns, [self.low, self.high], eps=1e-6, max_iter=_STEPS, verbose=0, output=io.StringIO()
        )
        return np.asarray(found, dtype=np.float64)

    def tied(self, positions: Array) -> Array:
        """Return a leg pose, made mirror-symmetric if this respects all joint limits and costs less than 0.05 more."""
        alike = positions.copy()
        for left, right, sign in self.pairs:
            alike[left] = (positions[left] + sign * positions[right]) / 2
            alike[right] = sign * alike[left]
        alike = np.round(alike, 4)
        fits = bool(np.all((alike >= self.low - 1e-3) & (alike <= self.high + 1e-3)))
        return alike if fits and self.cost(alike) < self.cost(positions) + 0.05 else np.round(positions, 5)

    def stance(self, positions: Array) -> Stance:
        self.at(positions)
        offset = self.offset()
        above = float((self.data.subtree_com[self.base] - self._centres().mean(axis=0)) @ self.up)
        lean = -math.atan2(offset, above) if above > 0 and self.one_axle else 0.0
        grounded = bool(np.ptp(self._clearances(self._centres())) <= _TOUCHES * self.size)
        balanced, by_name = abs(offset) <= _BALANCED * self.size, zip(self.joints, map(float, positions), strict=True)
        return Stance(dict(by_name), self._height(), offset, lean, self.tallest, balanced, grounded)


@dataclass(frozen=True)
class Weight:
    """The centre of mass of the robot without wheels, m: ``place`` in the world; ``ahead`` of, ``above`` the axle."""

    ahead: float
    above: float
    place: Array

    @property
    def lean(self) -> float:
        """The angle from the vertical to the line from the axle to the centre of mass, rad; positive forwards."""
        return math.atan2(self.ahead, self.above)


def weight_over_axle(robot: CompiledRobot) -> Weight:
    """Return the robot's centre of mass at the start of episodes; the robot must have a forward direction."""
    model, data, anatomy = robot.model, robot.data, robot.anatomy
    base = data.xmat[model.body(anatomy.base).id].reshape(3, 3)
    turned = {model.body(name).id for wheel in anatomy.standing for name in wheel.bodies}
    upper = [body for body in (model.body(name).id for name in robot.bodies) if body not in turned]
    mass = model.body_mass[upper]
    place = mass @ data.xipos[upper] / mass.sum()
    wheels = [wheel.joint for wheel in anatomy.standing]
    axle = np.mean([data.xanchor[model.joint(name).id] for name in wheels], axis=0)
    arm = base.T @ (place - axle)
    return Weight(float(arm @ np.array(anatomy.forward)), float(arm @ np.array(anatomy.up)), place)


def balanced_pose(robot: CompiledRobot) -> dict[str, float] | None:
    """Return positions of the leg joints that balance the robot with a level base; None if no positions do."""
    model = with_written_limits(robot.model, robot.report)
    stance = solve_stance(model, robot.anatomy, robot.data.qpos)
    return stance.positions or None if stance is not None and stance.balanced else None
