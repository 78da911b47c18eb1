"""Where the weight lies over the wheels, and the pose of the legs that puts it over the axle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.lint.robot.compiled import CompiledRobot, with_written_limits
from wheelleg_exp.lint.stance import solve_stance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weight:
    """The centre of mass of all but the wheels, against the middle of the axle.

    Attributes:
        ahead: along the forward axis, m.
        above: upwards, m.
        place: world, m, (3,).
    """

    ahead: float
    above: float
    place: Array

    @property
    def lean(self) -> float:
        """Angle from the upright to the line from the axle to the centre of mass, rad; positive to the front."""
        return math.atan2(self.ahead, self.above)


def weight_over_axle(robot: CompiledRobot) -> Weight:
    """Return where the weight lies as episodes begin; of a robot with wheels that roll one way."""
    model, anatomy = robot.model, robot.anatomy
    data = robot.data
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
    """Return leg positions that put the weight over the axle while the base stays level; None when there are none."""
    model = with_written_limits(robot.model, robot.report)
    stance = solve_stance(model, robot.anatomy, robot.data.qpos)
    return stance.positions if stance is not None and stance.balanced else None
