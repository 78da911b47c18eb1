"""Means over every control step of every environment: how long an episode lasts does not weigh in."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.rl.one_thread import one_thread

REWARDS, METRICS, TERMINATIONS = "Rewards_per_step", "Metrics_per_step", "Terminations_per_step"


class StepMeans:
    """Adds up what each control step was worth, and returns the means once per iteration.

    What managers log when environments are reset is of the episodes that end, and of those who fall early more
    often: here each environment counts alike in each step. Between iterations nothing is kept, so there is no state.

    Args:
        env: the environment.
    """

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        self._env = env
        self._sums: dict[tuple[str, tuple[str, ...]], torch.Tensor] = {}
        self._steps = 0

    def take(self) -> None:
        """Add the step that the environment has just made."""
        for key, rows in self._rows():
            if key in self._sums:
                self._sums[key] += rows
            else:
                self._sums[key] = rows.double()
        self._steps += 1

    def collect(self) -> dict[str, float]:
        """Return the means since the last call, over steps and environments, and forget them."""
        with one_thread():
            scalars = {
                f"{head}/{name}": value / self._steps
                for (head, names), sums in self._sums.items()
                for name, value in zip(names, sums.mean(dim=1).tolist(), strict=True)
            }
        self._sums.clear()
        self._steps = 0
        return scalars

    def _rows(self) -> Iterator[tuple[tuple[str, tuple[str, ...]], torch.Tensor]]:
        """Yield what each manager has for this step: head and names of the keys, and a row (N,) for each name."""
        rewards, terminations = self._env.reward_manager, self._env.termination_manager
        yield (REWARDS, tuple(rewards.active_terms)), rewards.step_reward
        yield (TERMINATIONS, tuple(terminations.active_terms)), terminations.fired
        for command, errors in self._env.command_manager.step_errors.items():
            names = self._env.command_manager.get_term(command).metric_names
            yield (METRICS, tuple(f"{command}/{name}" for name in names)), errors
