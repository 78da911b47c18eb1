"""Train in the ranks above 0, which write no files; rank 0 runs ``run_training`` and ``training_outputs``.

All ranks must call the collective operations in the same order, because each operation waits for all ranks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.jobs.train import run_training
from wheelleg_exp.jobs.train.training_outputs import checkpoint_due, digested
from wheelleg_exp.rl.ranks import FirstRankFailed, Ranks, digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.stop_request import StopRequest


class SilentDisplay:
    """A display that shows nothing."""

    def environment(self, description: str) -> None:
        """Show nothing."""

    def note(self, text: str) -> None:
        """Show nothing."""

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show nothing."""

    def steps(self, done: int, total: int) -> None:
        """Show nothing."""


def prepare_other_rank(composed: Composed, ranks: Ranks) -> Trainer:
    """Build environment and networks, as ``training.prepare`` does in the first process.

    Raises:
        WheellegError: the input is wrong; the first process says why.
    """
    with ranks.agreed():
        recipe = run_training.recipe_of(composed, SilentDisplay())
    with ranks.agreed():
        trainer, _ = run_training.build(recipe, ranks)
    ranks.facts(recipe.config)
    return trainer


def run_other_rank(trainer: Trainer, agent: Mapping[str, Any], stop: StopRequest) -> None:
    """Train as ``training.run`` does in the first process, and hand it what a checkpoint needs.

    Args:
        trainer: the training, at the iteration from which it goes on.
        agent: the composed ``agent`` section.
        stop: asks to stop; all stop after the same iteration.

    Raises:
        KeyboardInterrupt: training was stopped.
        WheellegError: the first process says why, or is gone.
    """
    total, state, unsaved = int(agent["max_iterations"]), None, False
    ranks = trainer.ranks
    stop.check(ranks.any(stop.requested))
    try:
        for iteration in trainer.learn(until=total):
            trainer.env.env.recorder_manager.take()
            state = trainer.state_dict()
            due = checkpoint_due(iteration.index, agent)
            digests_of_all(ranks, digested(trainer, state, due))
            stopped = ranks.any(stop.requested)
            unsaved = not (due or stopped)
            if not unsaved:
                state_of_all_ranks(ranks, state)
            stop.check(stopped)
    except FirstRankFailed as failure:
        if failure.keeps and unsaved and state is not None:
            state_of_all_ranks(ranks, state)
        raise
