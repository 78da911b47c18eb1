"""Rewards: weighted terms, summed into the reward and into per-episode sums."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.face import Env
from wheelleg_exp.managers.manager_base import ManagerBase, table
from wheelleg_exp.managers.term import Term


class RewardManager(ManagerBase):
    """``reward = sum of value * weight * dt``; a term of weight 0 is not called."""

    kind = "rewards"

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env) -> None:
        super().__init__(nodes, env)
        for term in self._terms.values():
            weight = term.fields.get("weight")
            if isinstance(weight, bool) or not isinstance(weight, (int, float)):
                raise ConfigError("a reward needs a weight", key=f"{term.path}.weight", expected="a number")
        self.step_reward = torch.zeros(len(self._terms), self._num_envs)
        self._episode_sums = torch.zeros_like(self.step_reward)
        self.non_finite: dict[int, list[str]] = {}

    def compute(self, dt: float) -> torch.Tensor:
        """Return this step's reward (N,); ``step_reward`` keeps each term's weighted value per second.

        A value that is not finite is never summed: its environment's step counts for nothing, and
        ``non_finite`` names the terms.
        """
        for row, term in zip(self.step_reward, self._terms.values(), strict=True):
            weight = term.fields["weight"]
            if weight == 0.0:
                row.zero_()
            else:
                torch.mul(self._value(term), weight, out=row)
        reward = self.step_reward.sum(dim=0).mul_(dt)
        self.non_finite.clear()
        if not torch.isfinite(reward).all():
            self._exclude(reward)
        self._episode_sums.add_(self.step_reward, alpha=dt)
        return reward

    def _value(self, term: Term) -> torch.Tensor:
        value = term(self._env)
        if value.shape != (self._num_envs,):
            raise ConfigError(
                f"'{term.target}' returned shape {tuple(value.shape)}",
                key=term.path,
                expected=f"({self._num_envs},)",
            )
        return value

    def _exclude(self, reward: torch.Tensor) -> None:
        """Take the environments whose reward is not finite out of this step, and name the terms."""
        ids = (~torch.isfinite(reward)).nonzero().squeeze(1)
        for env_id in ids.tolist():
            bad = (~self.step_reward[:, env_id].isfinite()).tolist()
            self.non_finite[env_id] = [name for name, flag in zip(self._terms, bad, strict=True) if flag]
        self.step_reward[:, ids] = 0.0
        reward[ids] = 0.0

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Return ``Episode_Reward/<term>``: mean of the episode sums over the longest episode's seconds."""
        means = self._episode_sums[:, env_ids].mean(dim=1) / self._env.max_episode_length_s
        self._episode_sums[:, env_ids] = 0.0
        self._reset_terms(env_ids)
        return {f"Episode_Reward/{n}": v for n, v in zip(self._terms, means.unbind(), strict=True)}

    def state_dict(self) -> dict[str, Any]:
        """Return the episode sums, this step's values, and the terms' states."""
        return {
            **super().state_dict(),
            "episode_sums": self._episode_sums.clone(),
            "step_reward": self.step_reward.clone(),
            "non_finite": {env_id: list(terms) for env_id, terms in self.non_finite.items()},
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self._episode_sums.copy_(saved["episode_sums"])
        self.step_reward.copy_(saved["step_reward"])
        self.non_finite = {env_id: list(terms) for env_id, terms in saved["non_finite"].items()}

    def __str__(self) -> str:
        rows = [
            (i, name, term.fields["weight"], term.target.rsplit(".", 1)[-1])
            for i, (name, term) in enumerate(self._terms.items())
        ]
        return table(f"Rewards: {len(rows)}", ("index", "name", "weight", "term"), rows)
