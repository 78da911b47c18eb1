"""What one frame holds: named rows of numbers, read from the environment where they already stand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.host import host_copy
from wheelleg_exp.mdp.commands import UniformVelocityCommand
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.sim.sensors import ContactSensor

VELOCITY_NAMES = ("v_x", "v_y", "w_z")
_GRAVITY = ("g_x", "g_y", "g_z")
_FREE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_FREE_VELOCITY = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


@dataclass(frozen=True)
class Channel:
    """One row of numbers a frame.

    Attributes:
        key: name within a frame.
        names: name of each number.
        read: returns the row, (len(names),).
        entities: one entity for the whole row, or one a number; none keeps the row for drawing only.
    """

    key: str
    names: tuple[str, ...]
    read: Callable[[], Any]
    entities: tuple[str, ...]


def robot_channels(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """Return what is recorded of one environment's robot and commands at every control step.

    Poses are not among it: they follow from ``qpos``, and are worked out when the frames are sent.
    """
    return [
        *_base(env, env_id, paths),
        *_commands(env, env_id, paths),
        *_joints(env, env_id, paths),
        *_contacts(env, env_id, paths),
    ]


def velocity_command(env: ManagerBasedRLEnv) -> str | None:
    """Return the name of the first command that is a planar velocity (v_x, v_y, w_z) in the base's axes."""
    manager = env.command_manager
    for name in manager.active_terms:
        if isinstance(manager.get_term(name), UniformVelocityCommand):
            return name
    return None


def has_forces(sensor: Any) -> bool:
    """Return whether a sensor of the scene measures contact forces."""
    return isinstance(sensor, ContactSensor)


def one(key: str, entity: str, names: Sequence[str], read: Callable[[], Any]) -> Channel:
    """Return a channel whose numbers stand in one entity."""
    return Channel(key, tuple(names), read, (entity,))


def row(read: Callable[[], torch.Tensor], env_id: int) -> Callable[[], Any]:
    """Return a reader of one environment's row."""
    return lambda: host_copy(read()[env_id])


def _base(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    data, model = env.scene.robot.data, env.scene.model
    qpos, qvel = (env.scene.sim.view(name)[env_id] for name in ("qpos", "qvel"))

    def split(key: str, names: Sequence[str], read: Callable[[], Any]) -> Channel:
        return Channel(key, tuple(names), read, tuple(paths.data("base", name) for name in names))

    return [
        split("height", ["height"], lambda: host_copy(data.root_pos_w[env_id, 2])),
        split("lin_vel", ["v_x", "v_y", "v_z"], row(lambda: data.root_lin_vel_b, env_id)),
        split("ang_vel", ["w_x", "w_y", "w_z"], row(lambda: data.root_ang_vel_b, env_id)),
        one("gravity", paths.data("base", "gravity"), _GRAVITY, row(lambda: data.projected_gravity_b, env_id)),
        one("qpos", paths.data("state", "qpos"), _coordinates(model, _FREE), lambda: host_copy(qpos)),
        one("qvel", paths.data("state", "qvel"), _coordinates(model, _FREE_VELOCITY), lambda: host_copy(qvel)),
    ]


def _coordinates(model: mujoco.MjModel, free: tuple[str, ...]) -> list[str]:
    """Return a name for each coordinate of qpos (or qvel): the joint's, with a suffix where it has several."""
    ball = ("w", "x", "y", "z") if len(free) == len(_FREE) else ("x", "y", "z")
    names = []
    for j in range(model.njnt):
        joint = model.joint(j).name or f"joint_{j}"
        kind = int(model.jnt_type[j])
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            names += [f"{joint}.{part}" for part in free]
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            names += [f"{joint}.{part}" for part in ball]
        else:
            names.append(joint)
    return names


def _commands(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """A velocity command stands in one entity a number, so that each can be plotted against what it is for."""
    velocity, found = velocity_command(env), []
    for name in env.command_manager.active_terms:
        term = env.command_manager.get_term(name)
        read = row(lambda term=term: term.command, env_id)  # type: ignore[misc]
        if name == velocity:
            names = tuple(f"{part} command" for part in VELOCITY_NAMES)
            entities = tuple(paths.data("commands", name, part) for part in VELOCITY_NAMES)
            found.append(Channel(f"commands/{name}", names, read, entities))
        else:
            names = tuple(f"{name}[{i}]" for i in range(term.command.shape[1]))
            found.append(one(f"commands/{name}", paths.data("commands", name), names, read))
    return found


def _joints(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    data, names = env.scene.robot.data, env.scene.robot.joint_names
    reads: dict[str, Callable[[], torch.Tensor]] = {
        "position": lambda: data.joint_pos,
        "position_target": lambda: data.joint_pos_target,
        "velocity": lambda: data.joint_vel,
        "velocity_target": lambda: data.joint_vel_target,
        "effort": lambda: data.applied_torque,
        "effort_computed": lambda: data.computed_torque,
    }
    return [
        Channel(
            f"joints/{kind}",
            tuple(f"{name} target" if kind.endswith("target") else name for name in names),
            row(read, env_id),
            tuple(paths.data("joints", name, kind) for name in names),
        )
        for kind, read in reads.items()
    ]


def _contacts(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    """Net forces of the last physics step, and the largest norm within the sensor's history, which terms read."""
    found = []
    for name, sensor in env.scene.sensors.items():
        if not has_forces(sensor):
            continue
        names = [f"{body}.{axis}" for body in sensor.body_names for axis in "xyz"]
        read = flat(lambda sensor=sensor: sensor.data.net_forces_w, env_id)  # type: ignore[misc]
        found.append(one(f"contacts/{name}", paths.data("contacts", name, "forces"), names, read))
        peak = row(lambda sensor=sensor: sensor.max_force_norm(), env_id)  # type: ignore[misc]
        found.append(one(f"peak/{name}", paths.data("contacts", name, "peak"), sensor.body_names, peak))
    return found


def flat(read: Callable[[], torch.Tensor], env_id: int) -> Callable[[], Any]:
    """Return a reader of one environment's numbers in one row."""
    return lambda: host_copy(read()[env_id]).ravel()
