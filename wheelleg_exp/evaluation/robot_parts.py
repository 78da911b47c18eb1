"""Which joints of a robot are wheels and which mirror which, found by geometry and never by a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wheelleg_exp.evaluation.task import contact_sensor
from wheelleg_exp.lint.anatomy.examine import anatomy_of
from wheelleg_exp.lint.anatomy.parts import Anatomy, Wheel
from wheelleg_exp.lint.robot_facts import at_default
from wheelleg_exp.managers import Env


@dataclass(frozen=True)
class RobotParts:
    """What metrics ask of a robot; indices are into its joints.

    Attributes:
        joint_names: of all joints, (J,).
        wheels: joints of driven wheels that carry the robot, (W,).
        contacts: name of the contact sensor that senses every body.
        wheel_bodies: the wheels' bodies, as columns of that sensor, (W,).
        wheel_offsets: how far to the left of the base each wheel stands, m, (W,); None where no way is forwards.
        left: driven joints of the legs on the left, (P,).
        right: their mirror images, (P,).
        sign: the image of ``left`` at q is ``right`` at sign · q, (P,).
        groups: joints of each actuator group by name.
        effort_limit: of each joint in each environment, N·m, (N, J); infinite where there is none.
        mass: of the robot, kg.
        gravity: m/s².
    """

    joint_names: tuple[str, ...]
    wheels: torch.Tensor
    contacts: str
    wheel_bodies: torch.Tensor
    wheel_offsets: torch.Tensor | None
    left: torch.Tensor
    right: torch.Tensor
    sign: torch.Tensor
    groups: dict[str, torch.Tensor]
    effort_limit: torch.Tensor
    mass: float
    gravity: float


def parts_of(env: Env) -> RobotParts:
    """Look at the robot of an environment at its default pose."""
    robot, model, device = env.scene.robot, env.scene.model, env.device
    names = robot.joint_names
    driven = [name for actuator in robot.actuators.values() for name in actuator.joint_names]
    anatomy = anatomy_of(model, at_default(model, robot).qpos, driven)
    wheels = [wheel for wheel in anatomy.standing if wheel.driven and wheel.joint in names]
    rolling = {wheel.joint for wheel in anatomy.wheels}
    pairs = [
        pair
        for pair in anatomy.mirrored
        if pair.left != pair.right and pair.left in driven and pair.right in driven and pair.left not in rolling
    ]
    contacts = contact_sensor(env.cfg["scene"]["sensors"])
    assert contacts is not None  # the evaluation's config has one
    bodies = env.scene[contacts].body_names

    def indices(found: list[int]) -> torch.Tensor:
        return torch.tensor(found, dtype=torch.long, device=device)

    return RobotParts(
        joint_names=tuple(names),
        wheels=indices([names.index(wheel.joint) for wheel in wheels]),
        contacts=contacts,
        wheel_bodies=indices([bodies.index(wheel.body) for wheel in wheels]),
        wheel_offsets=_offsets(anatomy, wheels, device),
        left=indices([names.index(pair.left) for pair in pairs]),
        right=indices([names.index(pair.right) for pair in pairs]),
        sign=torch.tensor([float(pair.sign) for pair in pairs], device=device),
        groups={
            name: indices([names.index(joint) for joint in actuator.joint_names])
            for name, actuator in robot.actuators.items()
        },
        effort_limit=robot.data.joint_effort_limits.clone(),
        mass=float(model.body_mass[robot.body_ids.tolist()].sum()),
        gravity=float(sum(g * g for g in model.opt.gravity) ** 0.5),
    )


def _offsets(anatomy: Anatomy, wheels: Sequence[Wheel], device: torch.device) -> torch.Tensor | None:
    if anatomy.forward is None:
        return None
    left = np.cross(anatomy.up, anatomy.forward)
    return torch.tensor([float(left @ np.array(wheel.contact)) for wheel in wheels], device=device)
