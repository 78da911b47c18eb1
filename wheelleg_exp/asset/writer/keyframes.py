"""Prints saved states: the file's own, and ``home``, where the file left the robot."""

from __future__ import annotations

from wheelleg_exp.asset.description import Dof, RobotDescription
from wheelleg_exp.asset.writer.attributes import IDENTITY
from wheelleg_exp.asset.writer.xml import Element

HOME = "home"


def keyframes(robot: RobotDescription) -> Element:
    """Return the ``<keyframe>`` of a robot; a keyframe of the file called ``home`` takes the place of ours."""
    out = Element("keyframe")
    positions, velocities = state(robot)
    controls = [_control(dof) for dof in robot.dofs if dof.drive] + [0.0] * len(robot.actuators)
    if positions and all(item.name != HOME for item in robot.keyframes):
        out.add(
            "key",
            name=HOME,
            qpos=positions,
            qvel=velocities if any(velocities) else None,
            ctrl=controls if any(controls) else None,
        )
    for item in robot.keyframes:
        out.add("key", item.extra, name=item.name)
    return out


def state(robot: RobotDescription) -> tuple[list[float], list[float]]:
    """Return qpos and qvel: the saved state, floating bases where they are drawn."""
    positions: list[float] = []
    velocities: list[float] = []
    for body in robot.bodies:
        if body.floating:
            positions += [*body.pose.position, *body.pose.rotation]
            velocities += body.velocity
        for dof in body.dofs:
            positions += IDENTITY if dof.kind == "ball" else (dof.position,)
            velocities += [0.0] * 3 if dof.kind == "ball" else [dof.velocity]
    return positions, velocities


def _control(dof: Dof) -> float:
    assert dof.drive is not None
    return {"position": dof.drive.target_position, "velocity": dof.drive.target_velocity, "motor": 0.0}[dof.drive.kind]
