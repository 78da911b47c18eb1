"""What rsl_rl's algorithms keep from one iteration to the next and leave out of their own ``save``."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO

from wheelleg_exp.sim.state import cloned


def unsaved_state(algorithm: PPO) -> dict[str, Any]:
    """Return the hidden states of recurrent networks, and the counter and the running return of RND's reward."""
    state: dict[str, Any] = {
        "learning_rate": float(algorithm.learning_rate),
        "hidden": {role: cloned(getattr(algorithm, role).get_hidden_state()) for role in ("actor", "critic")},
    }
    if algorithm.rnd is not None:
        state["rnd"] = {"update_counter": algorithm.rnd.update_counter, "average": _average(algorithm.rnd)}
    return state


def load_unsaved_state(algorithm: PPO, saved: dict[str, Any]) -> None:
    """Restore what ``unsaved_state`` returned."""
    algorithm.learning_rate = saved["learning_rate"]
    for role, hidden in saved["hidden"].items():
        network = getattr(algorithm, role)
        if network.is_recurrent:
            network.reset()
            network.reset(hidden_state=cloned(hidden))
    if algorithm.rnd is not None:
        algorithm.rnd.update_counter = saved["rnd"]["update_counter"]
        if algorithm.rnd.reward_normalization:
            algorithm.rnd.reward_normalizer.disc_avg.avg = cloned(saved["rnd"]["average"])


def _average(rnd: Any) -> torch.Tensor | None:
    return cloned(rnd.reward_normalizer.disc_avg.avg) if rnd.reward_normalization else None
