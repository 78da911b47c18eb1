"""What comparisons come to, in words."""

from __future__ import annotations

import math
from collections.abc import Sequence

from wheelleg_exp.evaluation.comparison import Difference

_LIMIT, _WORST = "push/limit_", "push/limit_worst_"


def verdict(found: Sequence[Difference], first: str, second: str, trainings: Sequence[int]) -> str:
    """Return in words what the differences come to.

    Args:
        found: the differences.
        first: what the method in question is called.
        second: what the other is called.
        trainings: of how many each is that was trained.
    """
    tested = [row for row in found if row.better and math.isfinite(row.interval.value)]
    better = [row.metric for row in tested if row.outcome == "better"]
    worse = [row.metric for row in tested if row.outcome == "worse"]
    if not better and not worse:
        said = f"No difference between {first} and {second} is beyond chance in any of {len(tested)} metrics."
    elif not worse:
        said = f"{first} is better than {second} in {_listed(better, len(tested))}, and worse in none."
    elif not better:
        said = f"{first} is worse than {second} in {_listed(worse, len(tested))}, and better in none."
    else:
        said = f"{first} is better than {second} in {_listed(better, len(tested))}, and worse in {_listed(worse)}."
    if min(trainings, default=0) == 1:
        said += " One training of a method alone tells policies apart, not methods: another seed may train another."
    return said


def push_verdict(found: Sequence[Difference], first: str, second: str) -> str:
    """Return in one line whether a method recovers from harder pushes than another; empty where none were measured.

    It is better where it survives harder pushes of every kind (at once, and over each length of a pulse) beyond chance.

    Args:
        found: the differences.
        first: what the method in question is called.
        second: what the other is called.
    """
    rows = {row.metric: row for row in found}
    kinds = [name.removeprefix(_WORST) for name in rows if name.startswith(_WORST)]
    limits = [(kind, rows[_LIMIT + kind]) for kind in kinds if _LIMIT + kind in rows]
    if not limits:
        return ""
    outcomes = {row.outcome for _, row in limits}
    if len(outcomes) == 1:
        word = f"{outcomes.pop() or 'neither better nor worse'} in push recovery than"
    elif {"better", "worse"} <= outcomes:
        word = "better in some pushes and worse in others than"
    else:
        word = f"{'better' if 'better' in outcomes else 'worse'} in some pushes, not in all, than"
    said = f"{first} is {word} {second}: it survives " + "; ".join(_limit(kind, row) for kind, row in limits) + "."
    ratios = [f"{row.second / row.first:.2g} times {_push(kind)}" for kind, row in limits if row.first]
    said += f" {second[0].upper()}{second[1:]} survives {' and '.join(ratios)} that {first} survives." if ratios else ""
    single = [row for name, row in rows.items() if name.startswith(_LIMIT) and "°" in name]
    counts = [(len([row for row in single if row.outcome == word]), word) for word in ("better", "worse")]
    told = " and ".join(f"{word} in {count}" for count, word in counts if count)
    return said + (f" Of {len(single)} directions and kinds it is {told}." if told else "")


def _push(kind: str, article: str = "the") -> str:
    return f"{article} kick" if kind == "0s" else f"{article} push over {kind.removesuffix('s')} s"


def _limit(kind: str, row: Difference) -> str:
    apart = f"{row.interval.value:+.3g}, 95 % interval {row.interval.low:+.3g} to {row.interval.high:+.3g}"
    sure = "" if row.p is None else f", p {row.p:.2g}"
    return f"{_push(kind, 'a')} of {row.first:.3g} against {row.second:.3g} {row.unit} ({apart}{sure})"


def _listed(names: Sequence[str], of: int | None = None) -> str:
    counted = f"{len(names)} metric" + ("s" if len(names) > 1 else "")
    return f"{counted}{'' if of is None else f' of {of}'} ({', '.join(names)})"
