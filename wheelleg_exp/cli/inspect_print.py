"""How ``wheelleg inspect`` prints what it found."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from wheelleg_exp.cli.common import print_table
from wheelleg_exp.cli.figures import shown, tool
from wheelleg_exp.inspection.columns import NumberEntry
from wheelleg_exp.inspection.compare import NumberDifference, RecordingComparison
from wheelleg_exp.inspection.frames import Frames
from wheelleg_exp.inspection.query import Hit
from wheelleg_exp.inspection.selection import Selection
from wheelleg_exp.inspection.statistics import Moment, Statistics
from wheelleg_exp.inspection.summary import Summary
from wheelleg_exp.recording.layout import DOCUMENTS, SIM_TIME
from wheelleg_exp.recording.reader import Recording
from wheelleg_exp.recording.repair import Repaired

Row = Sequence[str | None]
_NOTES = 3  # the last of what happened to the recording


def print_summary(summary: Summary, others: Sequence[Path], selection: Selection, status: str | None) -> None:
    """Print what a recording holds, and its figures as tables.

    Args:
        summary: the summary.
        others: the run's other recordings.
        selection: which rows its figures are of.
        status: of the run that it is the training of; None without one.
    """
    print_table(("recording", shown(Path(summary.path).absolute())), _head(summary, selection, status))
    if summary.purpose is None:
        print("\nThis was not recorded by wheelleg: there is no summary of what it tells.")
        print_table(
            ("entities below", "count", "rows"), [(p.name, f"{p.entities}", f"{p.rows}") for p in summary.parts]
        )
        return
    _section("episodes", ("figure", "value"), _episodes(summary))
    _section("sample episodes", ("iterations", "episodes", "survived", "lasted", "reward"), _samples(summary))
    _section("base", ("", "mean", "std", "RMS", "least", "most", "most at"), _base(summary))
    _section("tracking", ("velocity", "RMS error", "mean error", "largest", "mean command"), _tracking(summary))
    _section("contact forces", ("body", "largest within a step (N)", "at", "mean (N)", "in contact"), _forces(summary))
    _section("efforts", ("joint", "RMS", "largest", "limit", "at the limit"), _efforts(summary))
    _section("rewards", ("term", "weight", "mean (1/s)", "share"), _rewards(summary))
    _section("events", ("event", "times"), [(name, f"{count}") for name, count in summary.events.items()])
    _section("training", ("scalar", "first", "last", "lowest", "highest"), _training(summary))
    if others:
        print("\nother recordings of this run: " + ", ".join(shown(path) for path in others))


def print_statistics(found: Mapping[str, Statistics], units: Mapping[str, str]) -> None:
    """Print the statistics of numbers, one column a number, under their names and units."""
    rows: list[tuple[str, ...]] = [
        ("count", *(str(s.count) for s in found.values())),
        ("NaN", *(str(s.nan) for s in found.values())),
        *(
            (("infinite", *(str(s.infinite) for s in found.values())),)
            if any(s.infinite for s in found.values())
            else ()
        ),
        *((word, *(_number(getattr(s, word)) for s in found.values())) for word in ("mean", "std", "rms", "minimum")),
        ("  at", *(_when(s.minimum_at) for s in found.values())),
    ]
    shares = sorted({share for s in found.values() for share in s.quantiles})
    rows += [(f"{share:.0%}", *(_number(s.quantiles.get(share)) for s in found.values())) for share in shares]
    rows += [
        ("maximum", *(_number(s.maximum) for s in found.values())),
        ("  at", *(_when(s.maximum_at) for s in found.values())),
    ]
    print_table(("statistic", *(_named(name, units) for name in found)), rows)


def print_hits(hits: Sequence[Hit], limit: int, units: Mapping[str, str]) -> None:
    """Print the moments in which a condition holds, and the rows around each under the numbers' names and units."""
    several = len({hit.first.env_id for hit in hits}) > 1
    print(f"it holds {len(hits)} times" if len(hits) != 1 else "it holds once")
    if not limit:
        return
    if hits and hits[0].around is None:
        rows = [(_when(hit.first, several), _when(hit.last), str(hit.frames)) for hit in hits[:limit]]
        print_table(("from", "to", "frames"), rows)
    else:
        for hit in hits[:limit]:
            print(f"\n{_when(hit.first, several)}" + (f" to {_when(hit.last)}" if hit.frames > 1 else ""))
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
        print("they record other environments: " + " and ".join(_listed(r.env_ids) for r in (first, second)))
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


def _section(title: str, columns: Sequence[str], rows: Sequence[Row]) -> None:
    if rows:
        print(f"\n{title}")
        print_table(columns, rows)


def _head(summary: Summary, selection: Selection, status: str | None) -> list[Row]:
    own, health = summary.properties.get("wheelleg", {}), summary.health
    spans = summary.timelines
    what = " of ".join(str(word) for word in (summary.purpose or "another tool's", own.get("task")) if word)
    agent = f" ({own['agent']} agent)" if own.get("agent") not in (None, "policy") else ""
    rows: list[Row] = [
        ("what it is", what + agent),
        ("run", status),
        (
            "size",
            f"{health.size / 1e6:.2f} MB, {sum(part.rows for part in summary.parts)} rows of "
            f"{sum(part.entities for part in summary.parts)} entities",
        ),
        ("health", "; ".join(health.lines())),
        *(("note", event.text) for event in summary.notes[-_NOTES:]),
        ("environments", _listed(summary.env_ids) if summary.purpose else None),
    ]
    if "sim_time" in spans:
        rows.append(("simulated time", f"{spans['sim_time'].first:.3f} s to {spans['sim_time'].last:.3f} s"))
    rows += [
        (f"{name}s", f"{spans[name].first:.0f} to {spans[name].last:.0f}")
        for name in ("step", "iteration")
        if name in spans
    ]
    rows.append(("holds", ", ".join(part.name for part in summary.parts if part.rows or part.name == DOCUMENTS)))
    if not selection.is_all and summary.frames is not None:
        rows.append(("figures are of", "{} of {} frames".format(*summary.frames)))
    return [row for row in rows if row[1]]


def _listed(env_ids: Iterable[int]) -> str:
    return ", ".join(map(str, env_ids))


def _episodes(summary: Summary) -> list[Row]:
    f = summary.figures
    if not f.count:
        return []
    return [
        ("episodes", f"{f.count}"),
        ("survived to the time-out", _share(f.survival)),
        ("failed, timed out, unfinished", f"{f.failed}, {f.timed_out}, {f.unfinished}"),
        *((f"ended by {name}", f"{count}") for name, count in f.ended_by.items()),
        ("lasted, mean and longest", f"{_number(f.mean_duration_s)} s, {_number(f.longest_s)} s"),
        ("mean sum of rewards", _number(f.mean_reward)),
    ]


def _samples(summary: Summary) -> list[Row]:
    return [
        (
            f"{s.iteration} to {s.last_iteration}",
            f"{s.episodes}",
            _share(s.survival),
            "-" if s.mean_duration_s is None else f"{s.mean_duration_s:.2f} s",
            _number(s.mean_reward),
        )
        for s in summary.samples
    ]


def _base(summary: Summary) -> list[Row]:
    return [
        (
            f"{name} ({'m' if name == 'height' else 'rad'})",
            *(_number(value) for value in (s.mean, s.std, s.rms, s.minimum, s.maximum)),
            _when(s.maximum_at),
        )
        for name, s in summary.base.items()
    ]


def _tracking(summary: Summary) -> list[Row]:
    return [
        (f"{t.command}.{t.name}", *(_number(value) for value in (t.rmse, t.mean, t.largest, t.mean_command)))
        for t in summary.tracking
    ]


def _forces(summary: Summary) -> list[Row]:
    return [
        (
            f"{f.sensor}.{f.body}",
            _number(f.largest_n),
            _when(f.at) if f.largest_n else "",
            _number(f.mean_n),
            _share(f.contact_share),
        )
        for f in summary.forces
    ]


def _efforts(summary: Summary) -> list[Row]:
    return [
        (e.joint, _number(e.rms), _number(e.largest), _number(e.limit), _share(e.saturated_share))
        for e in summary.efforts
    ]


def _rewards(summary: Summary) -> list[Row]:
    ordered = sorted(summary.rewards, key=lambda reward: -(reward.share or 0.0))
    return [(r.term, _number(r.weight), _number(r.mean), _share(r.share)) for r in ordered]


def _training(summary: Summary) -> list[Row]:
    return [
        (
            t.name,
            _number(t.first),
            _number(t.last),
            f"{_number(t.lowest)} at {t.lowest_at}",
            f"{_number(t.highest)} at {t.highest_at}",
        )
        for t in summary.training
    ]


def _difference(found: NumberDifference) -> Row:
    at = "number of rows" if found.parting.step is None else _when(Moment(found.parting.step, found.parting.time_s))
    values = (found.parting.first, found.parting.second, found.largest)
    sides = (found.first.mean, found.second.mean, found.first.std, found.second.std)
    return (found.name, at, *(_number(value) for value in (*values, *sides)))


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
    return _number(value) if isinstance(value, float) else str(value)


def _when(moment: Moment | None, with_env: bool = False) -> str:
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


def _number(value: float | None) -> str:
    return "-" if value is None else "nan" if math.isnan(value) else f"{value:.4g}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
