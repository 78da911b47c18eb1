"""Compare checkpoints tensor by tensor, with one pair in memory at a time."""

from __future__ import annotations

import filecmp
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people
from wheelleg_exp.run.run_directory import RunDirectory, checkpoint_iteration

if TYPE_CHECKING:
    from wheelleg_exp.verify.tensor_differences import Difference


_MOST_LEAVES = 50  # stored per pair


@dataclass(frozen=True)
class Pair:
    """The checkpoints of one iteration in two runs.

    Attributes:
        iteration: the iteration.
        state: ``bytes`` (equal files), ``content`` (equal tensors in different bytes), ``different``, or
            ``unreadable``.
        count: how many leaves differ.
        of: how many leaves there are.
        differences: the leaves that differ: networks first, random streams last; within a part, the largest relative
            difference first.
        by_part: how many leaves differ in each part of the checkpoint.
        parameters: relative Euclidean distance of the networks' parameters; None if it was not needed.
        problem: why a file cannot be read.
    """

    iteration: int
    state: Literal["bytes", "content", "different", "unreadable"]
    count: int = 0
    of: int = 0
    differences: list[Difference] = field(default_factory=list)
    by_part: dict[str, int] = field(default_factory=dict)
    parameters: float | None = None
    problem: str | None = None

    @property
    def equal(self) -> bool:
        """Whether every number is equal bit for bit."""
        return self.state in ("bytes", "content")

    def as_dict(self) -> dict[str, Any]:
        """Return the pair for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class CheckpointComparison:
    """The compared checkpoints of two runs, and the iterations whose checkpoint only one run has."""

    pairs: list[Pair]
    only_a: list[int]
    only_b: list[int]


def compare_checkpoints(a: RunDirectory, b: RunDirectory, until: int) -> CheckpointComparison:
    """Compare the checkpoints of the iterations below ``until``."""
    ones, others = ({checkpoint_iteration(path): path for path in run.checkpoints()} for run in (a, b))
    common = sorted(i for i in ones if i in others and i < until)
    return CheckpointComparison(
        pairs=[compare_pair(i, ones[i], others[i]) for i in common],
        only_a=sorted(i for i in ones if i not in others and i < until),
        only_b=sorted(i for i in others if i not in ones and i < until),
    )


def compare_pair(iteration: int, a: Path, b: Path) -> Pair:
    """Compare two checkpoint files. Files with equal bytes are not loaded."""
    try:
        with for_people(a, "compare"):
            if filecmp.cmp(a, b, shallow=False):
                return Pair(iteration, "bytes")
        return _compare_content(iteration, a, b)
    except RunDirectoryError as error:
        return Pair(iteration, "unreadable", problem=str(error))


def _compare_content(iteration: int, a: Path, b: Path) -> Pair:
    from wheelleg_exp.rl import checkpoint
    from wheelleg_exp.verify import tensor_differences

    one, other = (checkpoint.load(path, finite=False) for path in (a, b))  # NaN is compared too
    found = list(tensor_differences.tree_differences(one, other))
    of = tensor_differences.count_leaves(one)
    if not found:
        return Pair(iteration, "content", of=of)
    found.sort(key=lambda difference: (_rank(difference.name), -_weight(difference)))
    distance = tensor_differences.relative_distance(_networks(one), _networks(other))
    parts = Counter(_part(difference.name) for difference in found)
    return Pair(iteration, "different", len(found), of, found[:_MOST_LEAVES], dict(parts), distance)


def _networks(state: dict[str, Any]) -> dict[str, Any]:
    from torch import Tensor

    from wheelleg_exp.rl import checkpoint

    networks = {role: state[f"{role}_state_dict"] for role in checkpoint.ROLES if f"{role}_state_dict" in state}
    tensors = {f"{role}.{name}": value for role, network in networks.items() for name, value in network.items()}
    return {name: value for name, value in tensors.items() if isinstance(value, Tensor)}


def _part(name: str) -> str:
    return "env.streams" if name.startswith("env.streams") else name.split(".")[0].split("[")[0]


def _rank(name: str) -> int:
    part = _part(name)
    order = ("actor_state_dict", "critic_state_dict", "student_state_dict", "env", "optimizer_state_dict")
    if part in order:
        return order.index(part)
    return len(order) + (part in ("env.streams", "rng"))


def _weight(difference: Difference) -> float:
    """Return the sort key: another shape or a missing tensor first, then NaN on one side, then the relative size."""
    if difference.kind != "values" or difference.relative is None:
        return 3.0
    return 2.5 if difference.relative != difference.relative else difference.relative
