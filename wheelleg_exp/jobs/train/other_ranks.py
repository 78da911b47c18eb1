"""Train in all ranks (processes) except rank 0, which runs ``run_training`` and writes all files.

All ranks must call the collective operations in the same order, because each operation waits until all ranks call it.
"""

from __future__ import annotations

from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.train.prepare_training import build_trainer, find_inputs
from wheelleg_exp.jobs.train.training_outputs import checkpoint_due, digested
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.ranks import FirstRankFailed, Ranks, digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.stop_request import StopRequest


def prepare_other_rank(composed: Composed, ranks: Ranks) -> tuple[Trainer, Learning]:
    """Prepare a training in a rank above 0; return the trainer and the agent's options. Rank 0 reports errors."""
    with ranks.agreed():
        recipe = find_inputs(composed, Display())
    with ranks.agreed():
        trainer, _ = build_trainer(recipe, ranks)
    ranks.facts(recipe.experiment.seed, recipe.experiment.agent.device)
    return trainer, recipe.experiment.agent


def run_other_rank(trainer: Trainer, agent: Learning, stop: StopRequest) -> None:
    """Train in a rank above 0, and send the training state to rank 0, which writes it into checkpoints."""
    total, state, unsaved = agent.max_iterations, None, False
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
        if failure.saves_state and unsaved and state is not None:
            state_of_all_ranks(ranks, state)
        raise
