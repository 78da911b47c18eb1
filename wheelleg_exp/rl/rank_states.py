"""The state of a training by several processes: one tree, in which what is not shared stands once for each.

The networks and their optimiser are the same in all. What each has for itself - environments, random streams, episode
sums, hidden states - is the tree's own for the first process, and stands under ``ranks`` for the others.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.rl import digests
from wheelleg_exp.rl.ranks import Ranks

OWN = ("unsaved", "env", "log", "rng")
RANKS = "ranks"


def whole(ranks: Ranks, state: Mapping[str, Any]) -> dict[str, Any]:
    """Return the state of all processes in the first, and in the others their own; all must call it.

    Args:
        ranks: the processes.
        state: this one's, as ``Trainer.state_dict`` gives it.
    """
    parts = ranks.gather({key: state[key] for key in OWN}) if ranks.together else []
    return {**state, RANKS: parts[1:]} if parts else dict(state)


def of_rank(state: Mapping[str, Any], rank: int) -> dict[str, Any]:
    """Return one process's state out of that of all."""
    own = state[RANKS][rank - 1] if rank else {}
    return {**{key: value for key, value in state.items() if key != RANKS}, **own}


def digests_of_all(ranks: Ranks, state: Mapping[str, Any]) -> tuple[dict[str, str], bool]:
    """Return the digests that the state of all will have, and whether all have the same networks; all must call it.

    Args:
        ranks: the processes.
        state: this one's, or a part of it.
    """
    mine = digests.of_state(state)
    if not ranks.together:
        return mine, True
    own = digests.of_state({key: state[key] for key in OWN if key in state})
    shared = {name: digest for name, digest in mine.items() if name not in own}
    told = ranks.tell_all({"own": own, "shared": shared})
    equal = all(one["shared"] == told[0]["shared"] for one in told)
    return digests.joined(told[0]["shared"] | told[0]["own"], [one["own"] for one in told[1:]]), equal
