"""The task: what was done last, what is asked for, and the time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated

import torch

from wheelleg_exp.constraints import NotEmpty, Positive
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.commands.travel import kept_travel_error


def last_action(env: Env, action_name: str | None = None) -> torch.Tensor:
    """Raw action of the whole manager, or of one term; 0 after a reset."""
    if action_name is None:
        return env.action_manager.action
    return env.action_manager.get_term(action_name).raw_actions


def generated_commands(env: Env, command_name: str) -> torch.Tensor:
    """The present command of a term."""
    return env.command_manager.get_command(command_name)


def travel_error(env: Env, command_name: str) -> torch.Tensor:
    """How far the robot is ahead of its velocity command, m, and turned too far, rad. Not in Isaac Lab.

    Args:
        env: the environment.
        command_name: a command that keeps it, ``UniformVelocityTravelCommand``.

    Returns:
        (N, 2).
    """
    return kept_travel_error(env, command_name)


def current_time_s(env: Env) -> torch.Tensor:
    """Time since the episode began, s."""
    return env.episode_length_buf.unsqueeze(1) * env.step_dt


def remaining_time_s(env: Env) -> torch.Tensor:
    """Time until the episode's end, s."""
    return env.max_episode_length_s - env.episode_length_buf.unsqueeze(1) * env.step_dt


def gait_phase(env: Env, period: Positive, offsets: Annotated[Sequence[float], NotEmpty()] = (0.0,)) -> torch.Tensor:
    """Sines, then cosines, of a gait's clock at each of its offsets: 2 pi (t / period + offset). Not in Isaac Lab.

    Args:
        env: the environment.
        period: one cycle, s; t is the time since the episode began.
        offsets: of each leg, say, as a share of the cycle.

    Returns:
        (N, 2 k) for k offsets.
    """
    cycles = env.episode_length_buf * (env.step_dt / period)
    angles = [2.0 * math.pi * (cycles + offset).frac() for offset in offsets]
    return torch.stack([angle.sin() for angle in angles] + [angle.cos() for angle in angles], dim=1)
