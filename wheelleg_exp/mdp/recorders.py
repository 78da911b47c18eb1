"""Recorders: what of each episode goes into the dataset of a run."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp.managers import Env, RecorderTerm
from wheelleg_exp.managers.recorder_manager import Noted


class InitialStateRecorder(RecorderTerm):
    """The state that an episode begins with (``initial_state``), a row; see ``PostStepStatesRecorder``."""

    def record_post_reset(self, env_ids: torch.Tensor) -> Noted:
        """Return the state of ``env_ids`` after the reset events."""
        return "initial_state", _rows(self._env.scene.get_state(is_relative=True), env_ids)


class PostStepStatesRecorder(RecorderTerm):
    """The state at the end of each control step (``states``), before resets.

    Below ``articulation/<name>``: ``root_pose`` (m, relative to the environment's origin; (w, x, y, z)),
    ``root_velocity`` (centre of mass, world axes, m/s and rad/s), ``joint_position`` (rad), ``joint_velocity`` (rad/s).
    """

    reads_observations = False

    def record_post_step(self) -> Noted:
        """Return the state of all environments."""
        return "states", self._env.scene.get_state(is_relative=True)


class PreStepActionsRecorder(RecorderTerm):
    """The raw action of each control step (``actions``)."""

    def record_pre_step(self) -> Noted:
        """Return the action that begins to act."""
        return "actions", self._env.action_manager.action


class PostStepProcessedActionsRecorder(RecorderTerm):
    """The processed action of each control step (``processed_actions``), term after term, such as joint targets."""

    reads_observations = False

    def record_post_step(self) -> Noted:
        """Return the processed actions of all terms side by side."""
        manager = self._env.action_manager
        return "processed_actions", torch.cat(
            [manager.get_term(name).processed_actions for name in manager.active_terms], dim=-1
        )


class PreStepFlatPolicyObservationsRecorder(RecorderTerm):
    """The observation that led to each action (``obs``), with its noise, as the policy saw it.

    Args:
        env: the environment.
        group: the observation group.
    """

    def __init__(self, env: Env, group: str = "policy") -> None:
        super().__init__(env)
        self._group = group

    def record_pre_step(self) -> Noted:
        """Return the observation of the group."""
        return "obs", self._env.observation_manager.obs_buf.get(self._group)


def _rows(value: Any, env_ids: torch.Tensor) -> Any:
    if isinstance(value, dict):
        return {name: _rows(item, env_ids) for name, item in value.items()}
    return value[env_ids]
