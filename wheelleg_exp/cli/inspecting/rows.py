"""How ``wheelleg inspect`` prints what it found."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.figures import shown, tool
from wheelleg_exp.cli.printing.tables import print_table
from wheelleg_exp.inspection.questions.columns import NumberEntry
from wheelleg_exp.inspection.questions.compare import NumberDifference, RecordingComparison
from wheelleg_exp.inspection.questions.query import Hit
from wheelleg_exp.inspection.questions.statistics import Moment, Statistics
from wheelleg_exp.inspection.questions.view import Frames
from wheelleg_exp.recording.layout import SIM_TIME
from wheelleg_exp.recording.reading.reader import Recording

if TYPE_CHECKING:
    from wheelleg_exp.recording.reading.repair import Repaired  # which imports rerun

Row = Sequence[str | None]


def print_statistics(found: Mapping[str, Statistics], units: Mapping[str, str]) -> None:
    """Print the statistics of numbers, one column a number, under their names and units."""
    several = len({moment.env_id for s in found.values() for moment in (s.first_at, s.last_at) if moment}) > 1
    rows: list[tuple[str, ...]] = [
        ("from", *(when(s.first_at, several) for s in found.values())),
        ("to", *(when(s.last_at, several) for s in found.values())),
        ("count", *(str(s.count) for s in found.values())),
        ("NaN", *(str(s.nan) for s in found.values())),
        *(
            (("infinite", *(str(s.infinite) for s in found.values())),)
            if any(s.infinite for s in found.values())
            else ()
        ),
        *((word, *(number(getattr(s, word)) for s in found.values())) for word in ("mean", "std", "rms", "minimum")),
        ("  at", *(when(s.minimum_at) for s in found.values())),
    ]
    shares = sorted({share for s in found.values() for share in s.quantiles})
    rows += [(f"{share:.0%}", *(number(s.quantiles.get(share)) for s in found.values())) for share in shares]
    rows += [
        ("maximum", *(number(s.maximum) for s in found.values())),
        ("  at", *(when(s.maximum_at) for s in found.values())),
    ]
    print_table(("statistic", *(_named(name, units) for name in found)), rows)


def print_hits(hits: Sequence[Hit], limit: int, units: Mapping[str, str]) -> None:
    """Print the moments in which a condition holds, and the rows around each under the numbers' names and units."""
    several = len({hit.first.env_id for hit in hits}) > 1
    print(f"it holds {len(hits)} times" if len(hits) != 1 else "it holds once")
    if not limit:
        return
    if hits and hits[0].around is None:
        rows = [(when(hit.first, several), when(hit.last), str(hit.frames)) for hit in hits[:limit]]
        print_table(("from", "to", "frames"), rows)
    else:
        for hit in hits[:limit]:
            print(f"\n{when(hit.first, several)}" + (f" to {when(hit.last)}" if hit.frames > 1 else ""))
            _print_rows(hit, units)
    if len(hits) > limit:
        print(f"… and {len(hits) - limit} more (--limit)")


def print_comparison(found: RecordingComparison, first: Recording, second: Recording, limit: int) -> None:
    """Print what is equal and what is not, and where the numbers part."""
    print(f"a: {shown(first.path.absolute())}\nb: {shown(second.path.absolute())}\n")
    if found.is_equal:
        print(f"equal to the last bit: {len(found.equal)} entities")
        return
    rows = [("equal", str(len(found.equal)), ""), ("different", str(len(found.different)), _some(found.different))]
    rows += [("only in a", str(len(found.only_first)), _some(found.only_first))] if found.only_first else []
    rows += [("only in b", str(len(found.only_second)), _some(found.only_second))] if found.only_second else []
    print_table(("entities", "count", ""), rows)
    if first.env_ids != second.env_ids:
        print("they record other environments: " + " and ".join(listed(r.env_ids) for r in (first, second)))
    if found.numbers:
        print("\nnumbers that differ, the first to part before the others")
        columns = ("number", "parts at", "a", "b", "largest difference", "mean a", "mean b", "std a", "std b")
        print_table(columns, [_difference(number) for number in found.numbers[:limit]])
        if len(found.numbers) > limit:
            print(f"… and {len(found.numbers) - limit} more (--limit)")


def print_repaired(done: Repaired) -> None:
    """Print what was mended and what is lost."""
    if done.output is None:
        print(f"{shown(done.path.absolute())} is whole; nothing was written")
        return
    for line in done.health.lines()[1:]:
        print(line)
    print(f"lost: {done.health.lost} of {done.health.size} bytes")
    if done.incomplete:
        print(f"rerun could not take over every row of: {_some(done.incomplete)}")
    if done.complaint:
        print(f"rerun's own check still says: {done.complaint}")
    print(f"mended: {shown(done.output.absolute())}\nopen it: {tool('rerun')} {shown(done.output.absolute())}")


def print_names(found: Sequence[NumberEntry]) -> None:
    """Print the names of numbers."""
    print_table(("number", "rows"), [(entry.name, str(entry.rows)) for entry in found])


def _difference(found: NumberDifference) -> Row:
    at = "number of rows" if found.parting.step is None else when(Moment(found.parting.step, found.parting.time_s))
    values = (found.parting.first, found.parting.second, found.largest)
    sides = (found.first.mean, found.second.mean, found.first.std, found.second.std)
    return (found.name, at, *(number(value) for value in (*values, *sides)))


def _print_rows(hit: Hit, units: Mapping[str, str]) -> None:
    frames = hit.around
    if frames is None:
        return
    columns = frames.table.column_names
    first, last = hit.first.step, hit.last.step
    rows = [
        ("*" if _inside(frames, row, first, last) else "", *(_cell(frames, name, row) for name in columns))
        for row in range(len(frames))
    ]
    print_table(("", *(_named(name, units) for name in columns)), rows)


def _named(name: str, units: Mapping[str, str]) -> str:
    return f"{name} ({units[name]})" if name in units else name


def _inside(frames: Frames, row: int, first: int | None, last: int | None) -> bool:
    step = frames.moment(row).step
    return step is not None and first is not None and last is not None and first <= step <= last


def _cell(frames: Frames, name: str, row: int) -> str:
    value = frames.table.column(name)[row].as_py()
    if name == SIM_TIME:
        return f"{value:.3f}"
    return number(value) if isinstance(value, float) else str(value)


def listed(env_ids: Iterable[int]) -> str:
    """Return environments as words."""
    return ", ".join(map(str, env_ids))


def when(moment: Moment | None, with_env: bool = False) -> str:
    """Return a moment as words."""
    if moment is None:
        return ""
    words = [] if moment.time_s is None else [f"{moment.time_s:.3f} s"]
    words += [] if moment.step is None else [f"step {moment.step}"]
    words += [] if moment.iteration is None else [f"iteration {moment.iteration}"]
    words += [f"env {moment.env_id}"] if with_env and moment.env_id is not None else []
    return ", ".join(words)


def _some(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:4]) + (", …" if len(listed) > 4 else "")


def number(value: float | None) -> str:
    """Return a number with four significant digits; a dash for none."""
    return "-" if value is None else "nan" if math.isnan(value) else f"{value:.4g}"
