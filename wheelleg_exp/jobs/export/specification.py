"""``policy.json`` of a bundle: everything between sensor readings and joint targets, as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.export.actions import action_specs
from wheelleg_exp.jobs.export.drives import drive_specs, finite, per_joint
from wheelleg_exp.jobs.export.observations import observation_specs, readings_of
from wheelleg_exp.jobs.export.readings import COMMANDS, reading
from wheelleg_exp.sim.sensors import Imu

FORMAT_VERSION = 1


def specification(
    env: ManagerBasedRLEnv, agent: Mapping[str, Any], ranges: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return what a deployer must know of an environment and its agent, but for the network.

    Lists by joint are in the order of ``joint_names``; null stands for a limit that there is not. Names are Isaac
    Lab's where it has one.

    Args:
        env: the environment, of one simulation and without events: numbers are the config's own.
        agent: the agent's section.
        ranges: of each command, [low, high] by component, as they were at the end of training.

    Raises:
        ConfigError: a runner without the simulation cannot do what a term does.
    """
    robot, layout = env.scene.robot, env.scene.robot.layout
    groups = observation_specs(env, agent["obs_groups"]["student" if "student" in agent else "actor"])
    actions, drives = action_specs(env), drive_specs(env)
    names = readings_of(groups)
    limits = [[finite(low), finite(high)] for low, high in layout.joint_pos_limits.tolist()]
    by_joint = per_joint(env, drives)
    return {
        "format_version": FORMAT_VERSION,
        "step_dt": env.step_dt,
        "physics_dt": env.physics_dt,
        "decimation": env.decimation,
        "robot_profile": robot.options.profile,
        "joint_names": list(robot.joint_names),
        "default_joint_pos": layout.default_joint_pos.tolist(),
        "default_joint_vel": layout.default_joint_vel.tolist(),
        "joint_pos_limits": limits,
        "rolling_joints": [robot.joint_names[i] for i in _rolling(limits, by_joint["stiffness"], actions)],
        **by_joint,
        "readings": {name: _reading(env, name) for name in names},
        "commands": {
            name.removeprefix(COMMANDS): dict(ranges.get(name.removeprefix(COMMANDS), {}))
            for name in names
            if name.startswith(COMMANDS)
        },
        "command_accelerations": _accelerations(env, names),
        "observation_width": sum(_width(term) for group in groups for term in group["terms"]),
        "observations": groups,
        "action_width": env.action_manager.total_action_dim,
        "clip_actions": agent.get("clip_actions"),
        "actions": actions,
        "actuators": drives,
        "imus": _imus(env, names),
        "root": {
            "body": robot.body_names[0],
            "floating": robot.floating,
            "pos": layout.default_root_pos.tolist(),
            "quat": layout.default_root_quat.tolist(),
        },
    }


def _rolling(limits: list[Any], stiffness: list[Any], actions: list[dict[str, Any]]) -> list[int]:
    """Return the joints whose positions count from the reset: without limits, and not driven to an absolute position.

    An encoder does not know how often a wheel has turned; in training each episode starts at the default position.
    """
    driven = {i: term["function"] for term in actions if term["drives"] == "position" for i in term["joint_ids"]}
    free = [i for i, pair in enumerate(limits) if pair == [None, None]]
    return [i for i in free if driven.get(i, "absolute" if stiffness[i] else "relative") == "relative"]


def _accelerations(env: ManagerBasedRLEnv, names: list[str]) -> dict[str, Any]:
    """Return by how much the commands that are read change at most, m/s² and rad/s², where they may not jump."""
    found = {}
    for name in (name.removeprefix(COMMANDS) for name in names if name.startswith(COMMANDS)):
        most = getattr(env.command_manager.get_term(name), "max_acceleration", None)
        if most is not None and any(limit is not None for limit in most):
            found[name] = list(most)
    return found


def _imus(env: ManagerBasedRLEnv, readings: list[str]) -> dict[str, Any]:
    """Return where the IMUs sit that are read."""
    found = {}
    for name, sensor in env.scene.sensors.items():
        if isinstance(sensor, Imu) and any(reading.rpartition(".")[0] == name for reading in readings):
            place = {"pos": sensor._offset_pos.tolist(), "quat": sensor._offset_quat.tolist()}
            found[name] = {"body": sensor.body_names[0], **place}
    return found


def _width(term: Mapping[str, Any]) -> int:
    return int(term["width"]) * max(1, int(term["history_length"]))


def _reading(env: ManagerBasedRLEnv, name: str) -> dict[str, Any]:
    known = reading(name)
    return {"width": known.of(env).shape[1], "unit": known.unit, "meaning": known.meaning}
