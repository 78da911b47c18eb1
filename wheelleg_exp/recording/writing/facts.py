"""What holds for a whole recording: its properties, and the names and limits that numbers are read with."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

import rerun as rr
import torch

from wheelleg_exp import __version__
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.blueprint import EnvLayout
from wheelleg_exp.recording.layout import FORMAT_VERSION, EnvPaths
from wheelleg_exp.recording.writing import kinematics

Statics = Iterator[tuple[str, list[Any]]]
ROBOT = "robot"


def own_facts(env: ManagerBasedRLEnv, env_ids: list[int], purpose: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the property ``wheelleg``: what the recording is of, and the steps and times to read it with.

    Args:
        env: the environment.
        env_ids: the recorded environments.
        purpose: what was done.
        given: what the caller knows besides (run id, task, checkpoint); it goes before what is found here.
    """
    found: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "purpose": purpose,
        "seed": env.seed,
        "step_dt": env.step_dt,
        "physics_dt": env.physics_dt,
        "decimation": env.decimation,
        "episode_length_s": env.max_episode_length_s,
        "max_episode_length": env.max_episode_length,
        "num_envs": env.num_envs,
        "env_ids": env_ids,
        "version": __version__,
        "rerun_version": rr.__version__,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return {**found, **{key: value for key, value in given.items() if value is not None}}


def robot_facts(env: ManagerBasedRLEnv, layout: EnvLayout) -> dict[str, Any]:
    """Return the property ``robot``: its bodies and joints, its weight (N) and how tall it stands (m)."""
    robot, model = env.scene.robot, env.scene.model
    root = int(model.body(robot.body_names[0]).id)
    facts: dict[str, Any] = {
        "root": robot.body_names[0],
        "bodies": list(robot.body_names),
        "joints": list(robot.joint_names),
        "weight": kinematics.weight(model, root),
        "height": layout.size,
        "contact_sensors": list(layout.sensors),
    }
    return facts if layout.command is None else {**facts, "velocity_command": layout.command}


def term_statics(env: ManagerBasedRLEnv, paths: EnvPaths) -> Statics:
    """Yield the terms of each manager in their order, with what their numbers are read with."""
    observations, actions = env.observation_manager, env.action_manager
    for group, terms in observations.active_terms.items():
        widths = [math.prod(shape) for shape in observations.group_obs_term_dim[group]]
        yield paths.data("observations", group), [rr.AnyValues(terms=terms, widths=widths)]
    rewards = env.reward_manager.active_terms
    # As configured: curricula change them on the way.
    weights = [float(env.cfg["rewards"][name]["weight"]) for name in rewards]
    yield from _listed(paths.data("rewards"), rewards, weights=weights)
    ends = env.termination_manager.active_terms
    over = [int(bool(env.termination_manager.get_term_cfg(name).fields.get("time_out", False))) for name in ends]
    yield from _listed(paths.data("terminations"), ends, time_out=over)
    yield from _listed(paths.data("actions"), actions.active_terms, widths=actions.action_term_dim)
    yield from _listed(paths.data("events"), list(interval_terms(env)))


def interval_terms(env: ManagerBasedRLEnv) -> list[str]:
    """Return the names of the events that happen in the middle of an episode."""
    manager = env.event_manager
    return manager.active_terms.get("interval", [])


def _listed(entity: str, terms: list[str], **values: Any) -> Statics:
    if terms:
        yield entity, [rr.AnyValues(terms=list(terms), **values)]


def joint_statics(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> Statics:
    """Yield each joint's limits and drive, and the environment's origin."""
    robot, data = env.scene.robot, env.scene.robot.data
    yield paths.data("joints"), [rr.AnyValues(names=list(robot.joint_names))]
    drives = _drives(env, env_id)
    for i, joint in enumerate(robot.joint_names):
        low, high = data.joint_pos_limits[env_id, i].tolist()
        stiffness, damping = drives.get(joint, (math.nan, math.nan))
        limits = rr.AnyValues(
            effort_limit=float(data.joint_effort_limits[env_id, i]),
            velocity_limit=float(data.soft_joint_vel_limits[env_id, i]),
            position_low=low,
            position_high=high,
            default_position=float(data.default_joint_pos[env_id, i]),
            stiffness=stiffness,
            damping=damping,
        )
        yield paths.data("joints", joint), [limits]
    yield paths.data("state"), [rr.AnyValues(origin=env.scene.env_origins[env_id].tolist())]


def _drives(env: ManagerBasedRLEnv, env_id: int) -> dict[str, tuple[float, float]]:
    """Return stiffness and damping of every driven joint of an environment."""
    found: dict[str, tuple[float, float]] = {}
    for actuator in env.scene.robot.actuators.values():
        rows = torch.stack((actuator.stiffness[env_id], actuator.damping[env_id]), dim=1).tolist()
        found.update(zip(actuator.joint_names, ((k, d) for k, d in rows), strict=True))
    return found
