"""Find the first difference between two runs, and describe the comparison of two runs as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field

from wheelleg_exp.config.explaining.config_diff import Change
from wheelleg_exp.verify.policy_differences import CheckpointComparison, Pair
from wheelleg_exp.verify.run_differences import FactDifference, as_dict, brief, decides
from wheelleg_exp.verify.run_parts import Part, Parting, Sides, Span


@dataclass(frozen=True)
class Divergence:
    """The first difference between two runs."""

    iteration: int | None  # The first training iteration in which two runs differ; None if no iteration is known.
    part: str  # ``part`` names what differs between two runs, such as ``settings`` or ``files`` (missing or damaged).
    name: str  # The name of the first difference between two runs, such as a config key or a tensor.
    a: object = None  # ``a`` and ``b`` are the differing values in runs A and B; None if a whole file differs.
    b: object = None
    details: Mapping[str, object] = field(default_factory=dict)
    text: str = ""  # ``text`` and the lines ``more`` describe the difference for the user.
    more: Sequence[str] = ()

    def as_dict(self) -> dict[str, object]:
        """Return the difference as a JSON document, without its texts."""
        return {key: value for key, value in asdict(self).items() if key not in ("text", "more")}

    def lines(self) -> list[str]:
        place = "" if self.iteration is None else f"iteration {self.iteration}: "
        return [f"first difference: {place}{self.text}", *self.more]


def first_divergence(
    changes: Mapping[str, Sequence[Change]],
    parts: Mapping[str, Part],
    parted: Parting | None,
    found: CheckpointComparison,
    span: Span,
    sides: Sides,
) -> Divergence | None:
    """Return the first difference: in ``changes`` of settings and robot, then in the numbers, then in the length."""
    inside = _first_of_numbers(parts, parted, found, sides)
    for name in changes:
        for change in changes[name][:1]:
            key, a, b, _ = as_dict(change).values()
            text = f"{name}: {key}: {brief(a)} in A, {brief(b)} in B"
            if inside is None:
                return Divergence(None, name, str(key), a, b, text=text)
            place = "" if inside.iteration is None else f"iteration {inside.iteration}, "
            more = f"  the numbers first differ at: {place}{inside.part}, {inside.name}"
            return Divergence(None, name, str(key), a, b, {"numbers": inside.as_dict()}, text, [more])
    if inside is None and span.shorter:
        a, b = (len(side.log.lines) for side in sides)
        name = f"{span.shorter} stops"
        return Divergence(span.until, "length", name, a, b, text=f"{name} ({a} and {b} iterations)")
    return inside


def _first_of_numbers(
    parts: Mapping[str, Part], parted: Parting | None, found: CheckpointComparison, sides: Sides
) -> Divergence | None:
    pair = next((pair for pair in found.pairs if not pair.equal), None)
    if parted is not None and (pair is None or parted.iteration <= pair.iteration):
        return _of_log(parted, pair, sides)
    if pair is not None:
        return _of_pair(pair, {} if parted is None else {"log_differs_from": parted.iteration})
    for name in ("recording", "exported", "results", "files"):
        if parts[name].state == "different":
            return Divergence(None, name, parts[name].text, text=f"{name}: {parts[name].text}")
    return None


def _of_log(parted: Parting, pair: Pair | None, sides: Sides) -> Divergence:
    one, other = (side.log.lines[parted.iteration] for side in sides)
    scalars = {name: [one.scalars.get(name), other.scalars.get(name)] for name in parted.scalars}
    equal = [name for name in parted.names if name not in parted.digests]
    details = {"digests": parted.digests, "equal_digests": equal, "scalars": scalars}
    more = [f"  {name}: {brief(a)} in A, {brief(b)} in B" for name, (a, b) in list(scalars.items())[:3]]
    more += [f"  and {len(scalars) - 3} more scalars"] if len(scalars) > 3 else []
    if pair is not None:
        checkpoint = _of_pair(pair, {})
        details = {**details, "checkpoint": checkpoint.as_dict()}
        more.append(f"  first differing checkpoint: {checkpoint.text}")
    if parted.digests:
        still = f" ({', '.join(equal)} still equal)" if equal else ""
        text, name = f"digests of {', '.join(parted.digests)}{still}", parted.digests[0]
        return Divergence(
            parted.iteration, "digests", name, one.digests[name], other.digests[name], details, text, more
        )
    text = f"scalars, while the digests {'are equal' if equal else 'cannot be compared'}"
    name, (a, b) = next(iter(scalars.items()))
    return Divergence(parted.iteration, "scalars", name, a, b, details, text, more)


def _of_pair(pair: Pair, details: Mapping[str, object]) -> Divergence:
    file = f"model_{pair.iteration}.pt"
    if pair.problem is not None:
        return Divergence(pair.iteration, "checkpoints", pair.problem, None, None, details, f"{file}: {pair.problem}")
    worst = pair.differences[0]
    more = {"kind": worst.kind, "index": list(worst.index), "largest": worst.largest, "relative": worst.relative}
    details = {**details, **more, "differing": pair.count, "of": pair.of, "by_part": pair.by_part}
    index = f"[{', '.join(map(str, worst.index))}]" if worst.index else ""
    values = f"{brief(worst.a)} and {brief(worst.b)}"
    if worst.kind != "values":
        what = f"{worst.name}: {worst.kind} ({values})"
    elif worst.largest is None:
        what = f"{worst.name}{index}: {values}"
    else:
        relative = "" if worst.relative is None else f", relative {worst.relative:.1e}"
        what = f"largest at {worst.name}{index}: {values}, apart {worst.largest:.1e}{relative}"
    parts = ", ".join(f"{count} in {part}" for part, count in pair.by_part.items())
    text = f"{file}: {pair.count} of {pair.of} entries differ ({parts}); {what}"
    return Divergence(pair.iteration, "checkpoints", worst.name, worst.a, worst.b, details, text)


_FACTS = 12  # The largest number of printed differences in the code, versions, and hardware of two runs.


def environment_lines(found: Sequence[FactDifference], settings: Sequence[Change], *, equal: bool) -> Iterator[str]:
    """Describe two runs' differences in code, hardware, and versions, and in settings that cannot change results."""
    harmless = [change for change in settings if not decides(change.keys)]
    if not (found or harmless):
        yield from ("", "environment: no recorded fact differs")
        return
    yield from ("", "these differ, but changed no number" if equal else "these differ, and may be the cause")
    rows = []
    # List two runs' code differences first, then causes of other rounding such as the CPU, and package versions last.
    for d in sorted(found, key=lambda d: (d.section == "distributions", not d.forbids, d.allows is None)):
        a, b = d.a, d.b
        if isinstance(a, list) and isinstance(b, list):
            a, b = ([x for x in one if x not in other] for one, other in ((a, b), (b, a)))
        allows = f"allows other rounding: {d.allows}" if d.allows else ""
        rows.append((f"{d.section}.{d.name}", _short(a, d.section), _short(b, d.section), allows))
    rows += [(change.key, brief(change.a), brief(change.b), "changes no number") for change in harmless]
    widths = [max(len(row[column]) for row in rows[:_FACTS]) for column in range(3)]
    for row in rows[:_FACTS]:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        yield "  " + "  ".join([*cells, row[3]]).rstrip()
    for note in dict.fromkeys(d.note for d in found if d.note):
        yield f"  {note}"
    if len(rows) > _FACTS:
        yield f"  and {len(rows) - _FACTS} more (--json lists all)"


def _short(value: object, section: str) -> str:
    """Return a fact as text; only the first 10 digits of a hash of the source code."""
    is_hash = section == "code" and isinstance(value, str) and len(value) in (40, 64)
    return str(value)[:10] if is_hash else brief(value)
