"""Recorder terms: the values of each episode that a run writes to its dataset."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import Env, RecorderTerm
from wheelleg_exp.managers.recorder_manager import Recorded


class InitialStateRecorder(RecorderTerm):
    """Record the robot's state at the start of each episode, as one row with the key ``initial_state``."""

    def record_post_reset(self, env_ids: torch.Tensor) -> Recorded:
        state = self._env.scene.get_state(is_relative=True)["articulation"]["robot"]
        rows = {name: value[env_ids] for name, value in state.items()}
        return "initial_state", {"articulation": {"robot": rows}}


class PostStepStatesRecorder(RecorderTerm):
    """Record the robot's state at the end of each control step, before resets, with the key ``states``.

    Below ``articulation/<name>``: ``root_pose`` (m from the environment's origin; w, x, y, z), ``root_velocity`` (of
    the centre of mass, world axes, m/s and rad/s), and ``joint_position`` and ``joint_velocity`` (rad, rad/s).
    """

    reads_observations = False

    def record_post_step(self) -> Recorded:
        return "states", self._env.scene.get_state(is_relative=True)


class PreStepActionsRecorder(RecorderTerm):
    """Record the raw action of each control step with the key ``actions``."""

    def record_pre_step(self) -> Recorded:
        return "actions", self._env.action_manager.action


class PostStepProcessedActionsRecorder(RecorderTerm):
    """Record the processed actions of all action terms in each control step with the key ``processed_actions``."""

    reads_observations = False

    def record_post_step(self) -> Recorded:
        manager = self._env.action_manager
        actions = [manager.get_term(name).processed_actions for name in manager.active_terms]
        return "processed_actions", torch.cat(actions, dim=-1)


class PreStepFlatPolicyObservationsRecorder(RecorderTerm):
    """Record the observation group ``group`` before each action, including noise, with the key ``obs``."""

    def __init__(self, env: Env, group: str = "policy") -> None:
        super().__init__(env)
        self._group = group

    def record_pre_step(self) -> Recorded:
        return "obs", self._env.observation_manager.obs_buf.get(self._group)
