"""Rewards: weighted terms, summed into the reward and into per-episode sums."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.managers.manager_base import ManagerBase, Term
from wheelleg_exp.managers.return_checks import TensorForm
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import not_finite


class RewardManager(ManagerBase):
    """The reward is the ``sum over terms of value * weight * dt``. A reward term with weight 0 is not called.

    Attributes:
        step_reward: weighted value of each term in this step, per second, (terms, N).
        failed: environments (N,) bool whose reward in this step was NaN or inf. Their reward is 0.
        non_finite: by index of a failed environment, the terms whose values were NaN or inf.
    """

    kind = "rewards"
    columns = ("weight",)

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env)
        self.step_reward = self.buffer("step_reward", torch.zeros(len(self._terms), self._num_envs, device=env.device))
        for term in self._terms.values():
            term.form = TensorForm(self._num_envs, env.device)
        self._sums = self.buffer("_sums", torch.zeros_like(self.step_reward))
        failed = torch.zeros(self._num_envs, dtype=torch.bool, device=env.device)
        self.failed = self.buffer("failed", failed, saved=False)
        self.non_finite: dict[int, list[str]] = self.number("non_finite", {})
        self._raw_values = self.buffer("_raw_values", self.step_reward.clone(), saved=False)
        self._zeros = torch.zeros(self._num_envs, device=env.device)
        self._read_weights()

    def start_step(self) -> None:
        """Clear ``non_finite``, and read the weights, which a curriculum changes and a CUDA graph cannot read."""
        self.non_finite.clear()
        if self._weights != self._present_weights():
            self._read_weights()

    def compute(self, dt: float, skipped: torch.Tensor | None = None) -> torch.Tensor:
        """Return the reward (N,) of a control step of ``dt`` s, which is 0 in the mask ``skipped`` (N,) bool."""
        if self._terms:
            weighted = zip(self._terms.values(), self._weights, strict=True)
            values = torch.stack([self._zeros if weight == 0.0 else term(self._env) for term, weight in weighted])
            torch.mul(values.to(self._factors.dtype), self._factors, out=self.step_reward)
        if skipped is not None:
            self.step_reward.masked_fill_(skipped, 0.0)
        reward = self.step_reward.sum(dim=0).mul_(dt)
        self.failed.copy_(not_finite(reward))
        self._sums.add_(torch.where(self.failed, self._zeros, self.step_reward), alpha=dt)
        return reward.masked_fill_(self.failed, 0.0)

    def _present_weights(self) -> list[float]:
        return [term.fields["weight"] for term in self._terms.values()]

    def _read_weights(self) -> None:
        self._weights = self.number("_weights", self._present_weights(), saved=False)
        factors = self.step_reward.new_tensor(self._weights).unsqueeze(1)
        self._factors = self.buffer("_factors", factors, saved=False)

    def exclude(self, env_ids: torch.Tensor) -> None:
        """Store the reward terms with NaN or inf in ``non_finite``, and set all rewards of ``env_ids`` to 0."""
        self._raw_values = self.step_reward.clone()
        for env_id in env_ids.tolist():
            bad = (~self.step_reward[:, env_id].isfinite()).tolist()
            self.non_finite[env_id] = [name for name, flag in zip(self._terms, bad, strict=True) if flag]
        self.step_reward[:, env_ids] = 0.0

    @property
    def raw_values(self) -> torch.Tensor:
        """The rewards of the present control step per term, (terms, N), including NaN and inf."""
        return self._raw_values if self.non_finite else self.step_reward

    @property
    def _episode_sums(self) -> dict[str, torch.Tensor]:
        """Reward sums over the current episodes, (N,) by term; curricula of Isaac Lab read this attribute."""
        return dict(zip(self._terms, self._sums.unbind(), strict=True))

    def episode_sums(self, name: str) -> torch.Tensor:
        """Return the sum of a term's rewards over the current episodes, (N,)."""
        self.get_term_cfg(name)
        return self._sums[self.active_terms.index(name)]

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return each term's weighted reward per second in this control step, for one environment."""
        return [(name, [value]) for name, value in zip(self._terms, self.step_reward[:, env_idx].tolist(), strict=True)]

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return ``Episode_Reward/<term>``: mean of the episode sums, divided by the longest episode's duration, s."""
        means = self._sums.index_select(1, env_ids).mean(dim=1) / self._env.max_episode_length_s
        self._sums.index_fill_(1, env_ids, 0.0)
        self._reset_terms(env_ids)
        return {f"Episode_Reward/{n}": v for n, v in zip(self._terms, means.unbind(), strict=True)}

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self._read_weights()

    def _cells(self, term: Term) -> tuple[object, ...]:
        return (term.fields["weight"],)
