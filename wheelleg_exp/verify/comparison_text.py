"""Find the first difference between two runs, and describe the comparison of two runs as text."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from wheelleg_exp.config.explaining.config_diff import Change
from wheelleg_exp.verify.policy_differences import CheckpointComparison, Pair
from wheelleg_exp.verify.run_differences import FactDifference, brief, decides
from wheelleg_exp.verify.run_parts import Part, Parting, Sides, Span


@dataclass(frozen=True)
class Divergence:
    """The first difference between two runs."""

    iteration: int | None  # The first training iteration in which two runs differ; None if no iteration is known.
    part: str  # ``part`` names what differs between two runs, such as ``settings`` or ``files`` (missing or damaged).
    name: str  # The name of the first difference between two runs, such as a config key or a tensor.
    a: Any = None  # ``a`` and ``b`` are the differing values in runs A and B; None if a whole file differs.
    b: Any = None
    details: dict[str, Any] = field(default_factory=dict)


def first_divergence(
    parts: dict[str, Part], parted: Parting | None, found: CheckpointComparison, span: Span, sides: Sides
) -> Divergence | None:
    """Return the first difference of two runs: settings and robot first, then the numbers, then their length."""
    inside = _first_of_numbers(parts, parted, found, sides)
    for name in ("settings", "robot"):
        if parts[name].state == "different":
            change = parts[name].details["differing"][0]
            details = {} if inside is None else {"numbers": asdict(inside)}
            return Divergence(None, name, change["key"], change["a"], change["b"], details)
    if inside is None and span.shorter:
        a, b = (len(side.log.lines) for side in sides)
        return Divergence(span.until, "length", f"{span.shorter} stops", a, b)
    return inside


def _first_of_numbers(
    parts: dict[str, Part], parted: Parting | None, found: CheckpointComparison, sides: Sides
) -> Divergence | None:
    pair = next((pair for pair in found.pairs if not pair.equal), None)
    if parted is not None and (pair is None or parted.iteration <= pair.iteration):
        return _of_log(parted, pair, sides)
    if pair is not None:
        details = {} if parted is None else {"log_differs_from": parted.iteration}
        return _of_pair(pair, details)
    for name in ("recording", "exported", "results", "files"):
        if parts[name].state == "different":
            return Divergence(None, name, parts[name].text)
    return None


def _of_log(parted: Parting, pair: Pair | None, sides: Sides) -> Divergence:
    one, other = (side.log.lines[parted.iteration] for side in sides)
    scalars = {name: [one.scalars.get(name), other.scalars.get(name)] for name in parted.scalars}
    details: dict[str, Any] = {"digests": parted.digests, "equal_digests": parted.equal_digests, "scalars": scalars}
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


_FACTS = 12  # The largest number of printed differences in the code, versions, and hardware of two runs.


def divergence_lines(first: Divergence) -> list[str]:
    """Return the lines of text that describe the first difference between two runs."""
    place = "" if first.iteration is None else f"iteration {first.iteration}: "
    lines = [f"first difference: {place}{_what(first)}"]
    if first.part in ("digests", "scalars"):
        scalars = first.details["scalars"]
        lines += [f"  {name}: {brief(a)} in A, {brief(b)} in B" for name, (a, b) in list(scalars.items())[:3]]
        lines += [f"  and {len(scalars) - 3} more scalars"] if len(scalars) > 3 else []
    inside = first.details.get("numbers")
    if inside is not None:
        place = "" if inside["iteration"] is None else f"iteration {inside['iteration']}, "
        lines.append(f"  the numbers first differ at: {place}{inside['part']}, {inside['name']}")
    checkpoint = first.details.get("checkpoint")
    if checkpoint is not None:
        lines.append(f"  first differing checkpoint: {_checkpoint_text(checkpoint)}")
    return lines


def environment_lines(found: Sequence[FactDifference], settings: Sequence[Change], *, equal: bool) -> Iterator[str]:
    """Describe two runs' differences in code, hardware, and versions, and in settings that cannot change results."""
    harmless = [change for change in settings if not decides(change.keys)]
    if not (found or harmless):
        yield from ("", "environment: no recorded fact differs")
        return
    yield from ("", "these differ, but changed no number" if equal else "these differ, and may be the cause")
    # List two runs' code differences first, then causes of other rounding such as the CPU, and package versions last.
    ordered = sorted(found, key=lambda d: (d.section == "distributions", not d.forbids, d.allows is None))
    rows = [_fact_row(difference) for difference in ordered]
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
    """Return one line of text that summarizes the comparison of two runs' checkpoints."""
    states = [pair.state for pair in found.pairs]
    kinds = {"bytes": "byte for byte", "content": "equal, in different bytes"}
    kinds |= {"different": "different", "unreadable": "unreadable"}
    texts = [f"{states.count(state)} {words}" for state, words in kinds.items() if state in states]
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
        equal = first.details["equal_digests"]
        still = f" ({', '.join(equal)} still equal)" if equal else ""
        return f"digests of {', '.join(first.details['digests'])}{still}"
    if first.part == "scalars":
        return f"scalars, while the digests {'are equal' if first.details['equal_digests'] else 'cannot be compared'}"
    if first.part == "checkpoints" and first.iteration is not None:
        return _checkpoint_text(asdict(first))
    return f"{first.part}: {first.name}"


def _checkpoint_text(found: Mapping[str, Any]) -> str:
    details, name = found["details"], f"model_{found['iteration']}.pt: "
    if "kind" not in details:
        return name + str(found["name"])
    parts = ", ".join(f"{count} in {part}" for part, count in details["by_part"].items())
    name += f"{details['differing']} of {details['of']} entries differ ({parts}); "
    values = f"{brief(found['a'])} and {brief(found['b'])}"
    if details["kind"] != "values":
        return f"{name}{found['name']}: {details['kind']} ({values})"
    index = f"[{', '.join(map(str, details['index']))}]" if details["index"] else ""
    if details["largest"] is None:
        return f"{name}{found['name']}{index}: {values}"
    relative = "" if details["relative"] is None else f", relative {details['relative']:.1e}"
    return f"{name}largest at {found['name']}{index}: {values}, apart {details['largest']:.1e}{relative}"


def _fact_row(difference: FactDifference) -> tuple[str, str, str, str]:
    a, b = difference.a, difference.b
    if isinstance(a, list) and isinstance(b, list):
        a, b = ([x for x in one if x not in other] for one, other in ((a, b), (b, a)))
    allows = f"allows other rounding: {difference.allows}" if difference.allows else ""
    return f"{difference.section}.{difference.name}", _short(a, difference), _short(b, difference), allows


def _short(value: object, difference: FactDifference) -> str:
    """Return a fact as text; only the first 10 digits of a hash of the source code."""
    is_hash = difference.section == "code" and isinstance(value, str) and len(value) in (40, 64)
    return str(value)[:10] if is_hash else brief(value)
