"""The first difference of two runs, and the parts of a comparison as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from wheelleg_exp.config.explaining.config_diff import Change
from wheelleg_exp.verify.policy_differences import CheckpointComparison, Pair
from wheelleg_exp.verify.run_differences import FactDifference, brief, decides
from wheelleg_exp.verify.run_parts import Measured, Part, Parting, Span


@dataclass(frozen=True)
class Divergence:
    """The first difference of two runs.

    Attributes:
        iteration: the first iteration that differs; None if the difference belongs to no iteration.
        part: ``settings``, ``robot``, ``digests``, ``scalars``, ``checkpoints``, ``recording``, ``exported``,
            ``results``, ``files`` (a file is missing or damaged) or ``length``.
        name: the first key, digest, scalar, tensor, or entity that differs.
        a: its value in A, if it is a single value.
        b: its value in B.
        details: further names, what is still equal, and the tensor's index and differences.
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
    """Return the first difference of two runs: settings and robot first, then the numbers, then their length."""
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
    details = {**details, **more, "differing": pair.count, "of": pair.of, "by_part": pair.by_part}
    return Divergence(pair.iteration, "checkpoints", worst.name, worst.a, worst.b, details)


_FACTS = 12  # differences of the environment that are shown
_DIGITS = 10


def run_line(name: str, side: Measured) -> str:
    """Return one line with the run's name, status, and length."""
    return f"{name}  {side.label}  {side.status}, {len(side.log.lines)} iterations"


def divergence_lines(first: Divergence) -> list[str]:
    """Return the printed lines of the first difference."""
    place = "" if first.iteration is None else f"iteration {first.iteration}: "
    lines = [f"first difference: {place}{_what(first)}"]
    if first.part in ("digests", "scalars"):
        lines += list(_log_lines(first.details))
    inside = first.details.get("numbers")
    if inside is not None:
        place = "" if inside["iteration"] is None else f"iteration {inside['iteration']}, "
        lines.append(f"  the numbers first differ at: {place}{inside['part']}, {inside['name']}")
    checkpoint = first.details.get("checkpoint")
    if checkpoint is not None:
        lines.append(f"  first differing checkpoint: {_checkpoint_text(checkpoint)}")
    return lines


def environment_lines(found: Sequence[FactDifference], settings: Sequence[Change], *, equal: bool) -> Iterator[str]:
    """Yield lines on differences of the environment and of settings that change no number."""
    harmless = [change for change in settings if not decides(change.keys)]
    if not (found or harmless):
        yield from ("", "environment: no recorded fact differs")
        return
    title = "these differ, but changed no number" if equal else "these differ, and may be the cause"
    yield from ("", title)
    rows = [_fact_row(difference) for difference in _by_weight(found)]
    rows += [(change.key, brief(change.a), brief(change.b), "changes no number") for change in harmless]
    widths = [max(len(row[column]) for row in rows[:_FACTS]) for column in range(3)]
    for row in rows[:_FACTS]:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=False)]
        yield "  " + "  ".join([*cells, row[3]]).rstrip()
    for note in dict.fromkeys(d.note for d in found if d.note):
        yield f"  {note}"
    if len(rows) > _FACTS:
        yield f"  and {len(rows) - _FACTS} more (--json lists all)"


def checkpoints_text(found: CheckpointComparison) -> str:
    """Return one line on all pairs of checkpoints."""
    states = [pair.state for pair in found.pairs]
    kinds = (
        ("bytes", "byte for byte"),
        ("content", "equal, in different bytes"),
        ("different", "different"),
        ("unreadable", "unreadable"),
    )
    texts = [f"{states.count(state)} {words}" for state, words in kinds if state in states]
    texts += [f"{len(only)} only in {side}" for side, only in (("A", found.only_a), ("B", found.only_b)) if only]
    first = next((pair for pair in found.pairs if not pair.equal), None)
    if first is not None:
        texts.append(first.problem or f"the first model_{first.iteration}.pt")
    return ", ".join(texts)


def _what(first: Divergence) -> str:
    if first.part in ("settings", "robot"):
        return f"{first.part}: {first.name}: {brief(first.a)} in A, {brief(first.b)} in B"
    if first.part == "length":
        return f"{first.name} ({first.a} and {first.b} iterations)"
    if first.part == "digests":
        still = first.details["equal_digests"]
        return f"digests of {', '.join(first.details['digests'])}" + (
            f" ({', '.join(still)} still equal)" if still else ""
        )
    if first.part == "scalars":
        return f"scalars, while the digests {'are equal' if first.details['equal_digests'] else 'cannot be compared'}"
    if first.part == "checkpoints" and first.iteration is not None:
        return _checkpoint_text(
            {"iteration": first.iteration, "name": first.name, "a": first.a, "b": first.b, "details": first.details}
        )
    return f"{first.part}: {first.name}"


def _log_lines(details: Mapping[str, Any]) -> Iterator[str]:
    scalars = details["scalars"]
    for name, (one, other) in list(scalars.items())[:3]:
        yield f"  {name}: {brief(one)} in A, {brief(other)} in B"
    if len(scalars) > 3:
        yield f"  and {len(scalars) - 3} more scalars"


def _checkpoint_text(found: Mapping[str, Any]) -> str:
    details = found["details"]
    name = f"model_{found['iteration']}.pt: "
    if "kind" not in details:
        return name + str(found["name"])
    parts = ", ".join(f"{count} in {part}" for part, count in details["by_part"].items())
    count = f"{details['differing']} of {details['of']} entries differ ({parts}); "
    return name + count + _leaf(found["name"], details["kind"], details, found["a"], found["b"])


def _leaf(name: str, kind: str, details: Mapping[str, Any], a: Any, b: Any) -> str:
    if kind != "values":
        return f"{name}: {kind} ({brief(a)} and {brief(b)})"
    index = f"[{', '.join(map(str, details['index']))}]" if details["index"] else ""
    if details["largest"] is None:
        return f"{name}{index}: {brief(a)} and {brief(b)}"
    relative = "" if details["relative"] is None else f", relative {details['relative']:.1e}"
    return f"largest at {name}{index}: {brief(a)} and {brief(b)}, apart {details['largest']:.1e}{relative}"


def _by_weight(differences: Sequence[FactDifference]) -> list[FactDifference]:
    """Sort: other code first, then differences that allow other numbers; installed distributions last."""
    return sorted(differences, key=lambda d: (d.section == "distributions", not d.forbids, d.allows is None))


def _fact_row(difference: FactDifference) -> tuple[str, str, str, str]:
    a, b = difference.a, difference.b
    if isinstance(a, list) and isinstance(b, list):
        a, b = ([x for x in one if x not in other] for one, other in ((a, b), (b, a)))
    values = [_hash(x) if difference.section == "code" else x for x in (a, b)]
    allows = f"allows other rounding: {difference.allows}" if difference.allows else ""
    return f"{difference.section}.{difference.name}", brief(values[0]), brief(values[1]), allows


def _hash(value: Any) -> Any:
    return value[:_DIGITS] if isinstance(value, str) and len(value) in (40, 64) else value
