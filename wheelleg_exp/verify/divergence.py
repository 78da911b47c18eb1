"""The first place where two runs part."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from wheelleg_exp.verify.checkpoints import CheckpointComparison, Pair
from wheelleg_exp.verify.compared_runs import Measured, Span
from wheelleg_exp.verify.parts import Part, Parting


@dataclass(frozen=True)
class Divergence:
    """The first place where two runs part.

    Attributes:
        iteration: the first iteration that differs; None when what differs belongs to no iteration.
        part: ``settings``, ``robot``, ``digests``, ``scalars``, ``checkpoints``, ``recording``, ``exported``,
            ``results``, ``files`` (something is missing or damaged) or ``length``.
        name: the key, digest, scalar, tensor or entity, the first one where there are several.
        a: its value in A, as far as it is one value.
        b: its value in B.
        details: everything else: further names, what was still equal, the tensor's index and differences.
    """

    iteration: int | None
    part: str
    name: str
    a: Any = None
    b: Any = None
    details: dict[str, Any] = field(default_factory=dict)


def first_divergence(
    parts: dict[str, Part],
    parted: Parting | None,
    found: CheckpointComparison,
    span: Span,
    sides: tuple[Measured, Measured],
) -> Divergence | None:
    """Return where two runs part: what they were asked first, then the numbers, then their length."""
    for name in ("settings", "robot"):
        if parts[name].state == "different":
            change = parts[name].details["differing"][0]
            inside = _first_of_numbers(parts, parted, found, sides)
            details = {} if inside is None else {"numbers": asdict(inside)}
            return Divergence(None, name, change["key"], change["a"], change["b"], details)
    inside = _first_of_numbers(parts, parted, found, sides)
    one, other = sides
    if inside is None and span.shorter:
        return Divergence(span.until, "length", f"{span.shorter} stops", len(one.log.lines), len(other.log.lines))
    return inside


def _first_of_numbers(
    parts: dict[str, Part], parted: Parting | None, found: CheckpointComparison, sides: tuple[Measured, Measured]
) -> Divergence | None:
    pair = next((pair for pair in found.pairs if not pair.equal), None)
    if parted is not None and (pair is None or parted.iteration <= pair.iteration):
        return _of_log(parted, pair, sides)
    if pair is not None:
        details: dict[str, Any] = {} if parted is None else {"log_differs_from": parted.iteration}
        return _of_pair(pair, details)
    for name in ("recording", "exported", "results", "files"):
        if parts[name].state == "different":
            return Divergence(None, name, parts[name].text)
    return None


def _of_log(parted: Parting, pair: Pair | None, sides: tuple[Measured, Measured]) -> Divergence:
    one, other = (side.log.lines[parted.iteration] for side in sides)
    details: dict[str, Any] = {
        "digests": parted.digests,
        "equal_digests": parted.equal_digests,
        "scalars": {name: [one.scalars.get(name), other.scalars.get(name)] for name in parted.scalars},
    }
    if pair is not None:
        details["checkpoint"] = asdict(_of_pair(pair, {}))
    if parted.digests:
        name = parted.digests[0]
        return Divergence(parted.iteration, "digests", name, one.digests[name], other.digests[name], details)
    name = parted.scalars[0]
    return Divergence(parted.iteration, "scalars", name, one.scalars.get(name), other.scalars.get(name), details)


def _of_pair(pair: Pair, details: dict[str, Any]) -> Divergence:
    if pair.problem is not None:
        return Divergence(pair.iteration, "checkpoints", pair.problem, details=details)
    worst = pair.differences[0]
    more = {"kind": worst.kind, "index": list(worst.index), "largest": worst.largest, "relative": worst.relative}
    told = {**details, **more, "differing": pair.count, "of": pair.of, "by_part": pair.by_part}
    return Divergence(pair.iteration, "checkpoints", worst.name, worst.a, worst.b, told)
