"""Adapt an environment to the interface that rsl_rl expects."""

from __future__ import annotations

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from wheelleg_exp.env import ManagerBasedRLEnv, Observations
from wheelleg_exp.rl.symmetry import Mirror, MirroredHalf


class RslRlVecEnv(VecEnv):
    """Adapts ``ManagerBasedRLEnv``, which is reset, to rsl_rl's ``VecEnv``; ``clip_actions`` bounds raw actions."""

    def __init__(self, env: ManagerBasedRLEnv, clip_actions: float | None = None) -> None:
        self.env = env
        self.num_envs = env.num_envs
        self.num_actions = env.action_manager.total_action_dim
        self.max_episode_length = env.max_episode_length
        self.device = str(env.device)
        self.cfg = dict(env.cfg)
        self._clip_actions = clip_actions
        self._is_finite = env.options.is_finite_horizon
        self.mirror: Mirror | None = None  # ``mirror`` mirrors samples for rsl_rl's symmetry extension.
        self.half: MirroredHalf | None = None  # ``half`` mirrors every second environment during training.
        env.reset()

    @property
    def unwrapped(self) -> ManagerBasedRLEnv:
        """The environment itself. rsl_rl's RND reads its step duration."""
        return self.env

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """The number of control steps since the start of each environment's episode, (N,)."""
        return self.env.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: torch.Tensor) -> None:
        self.env.episode_length_buf.copy_(value)

    def get_observations(self) -> TensorDict:
        """Return the last observations without drawing random numbers or changing the environment's state."""
        # A copy, because with CUDA graphs the next step overwrites the memory of the observations.
        return self._as_tensordict(self.env.observation_manager.obs_buf).clone()

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, object]]:
        """Apply the actions (N, A) of one control step; return observations, rewards (N,), dones (N,), and extras.

        ``extras`` contains ``time_outs`` (N,), except if ``env.is_finite_horizon`` is set. At a time-out, rsl_rl adds
        the discounted value of the state before the step, because the next state already belongs to a new episode.
        """
        if self._clip_actions is not None:
            actions = actions.clamp(-self._clip_actions, self._clip_actions)
        if self.half is not None:
            actions = self.half.actions(actions)
        observations, rewards, terminated, time_outs, extras = self.env.step(actions)
        dones = (terminated | time_outs).long()
        time_limits = {} if self._is_finite else {"time_outs": time_outs}
        return self._as_tensordict(observations), rewards, dones, {**extras, **time_limits}

    def policy_actions(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the policy's actions (N, A) for which ``step`` applies the raw actions ``actions`` (N, A)."""
        if self.half is not None:
            actions = self.half.actions(actions)
        return actions if self._clip_actions is None else actions.clamp(-self._clip_actions, self._clip_actions)

    def _as_tensordict(self, observations: Observations) -> TensorDict:
        found = TensorDict(dict(observations), batch_size=[self.num_envs])
        return found if self.half is None else self.half.observations(found)
