"""What the processes of a training do that write nothing: the first one's part is in ``training`` and ``outputs``.

Both take the same steps in the same order, because each word between processes waits for all of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.jobs.stop import StopRequest
from wheelleg_exp.jobs.train import training
from wheelleg_exp.jobs.train.outputs import checkpoint_due, digested
from wheelleg_exp.rl.rank_errors import ToldByFirst
from wheelleg_exp.rl.rank_states import digests_of_all, whole
from wheelleg_exp.rl.ranks import Ranks
from wheelleg_exp.rl.trainer import Iteration, Trainer


class Silent:
    """A display that shows nothing."""

    def environment(self, description: str) -> None:
        """Show nothing."""

    def note(self, text: str) -> None:
        """Show nothing."""

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Show nothing."""

    def steps(self, done: int, total: int) -> None:
        """Show nothing."""


def prepare(composed: Composed, ranks: Ranks) -> Trainer:
    """Build environment and networks, as ``training.prepare`` does in the first process.

    Raises:
        WheellegError: the input is wrong; the first process says why.
    """
    with ranks.agreed():
        recipe = training.recipe_of(composed, Silent())
    with ranks.agreed():
        trainer, _ = training.build(recipe, ranks)
    ranks.facts(recipe.config)
    return trainer


def run(trainer: Trainer, agent: Mapping[str, Any], stop: StopRequest) -> None:
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
                whole(ranks, state)
            stop.check(stopped)
    except ToldByFirst as failure:
        if failure.keeps and unsaved and state is not None:
            whole(ranks, state)
        raise
