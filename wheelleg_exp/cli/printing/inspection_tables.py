"""Print the contents and statistics of a recording for ``wheelleg inspect``."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.terminal import hanging, print_table, shown, tool
from wheelleg_exp.definitions import (
    ENDED_AS,
    RECORDED,
    SHARE,
    STEPS,
    percent,
    recorded_headings,
    scalar_definition,
    share,
)
from wheelleg_exp.inspection.compare_recordings import NumberDifference, RecordingComparison
from wheelleg_exp.inspection.condition_query import Hit
from wheelleg_exp.inspection.recorded_numbers import Frames, Moment, Statistics
from wheelleg_exp.inspection.recording_summary import Summary
from wheelleg_exp.inspection.row_selection import Selection
from wheelleg_exp.recording.layout import DOCUMENTS, SIM_TIME, unit
from wheelleg_exp.recording.reading.recording_reader import Recording

if TYPE_CHECKING:
    from wheelleg_exp.recording.reading.recording_repair import Repaired

Row = Sequence[str | None]


def print_statistics(found: Mapping[str, Statistics], units: Mapping[str, str]) -> None:
    """Print a table of statistics with one column for each recorded number."""
    all_found = found.values()
    several = len({moment.env_id for s in all_found for moment in (s.first_at, s.last_at) if moment}) > 1
    rows: list[tuple[str, ...]] = [
        ("from", *(when(s.first_at, several) for s in all_found)),
        ("to", *(when(s.last_at, several) for s in all_found)),
        ("count", *(str(s.count) for s in all_found)),
        ("NaN", *(str(s.nan) for s in all_found)),
    ]
    if any(s.infinite for s in all_found):
        rows.append(("infinite", *(str(s.infinite) for s in all_found)))
    rows += [(word, *(number(getattr(s, word)) for s in all_found)) for word in ("mean", "std", "rms", "minimum")]
    rows.append(("  at", *(when(s.minimum_at) for s in all_found)))
    for part in sorted({part for s in all_found for part in s.quantiles}):
        rows.append((f"{part:.0%}", *(number(s.quantiles.get(part)) for s in all_found)))
    rows.append(("maximum", *(number(s.maximum) for s in all_found)))
    rows.append(("  at", *(when(s.maximum_at) for s in all_found)))
    print_table(("statistic", *(_named(name, units) for name in found)), rows)


def print_hits(hits: Sequence[Hit], limit: int, units: Mapping[str, str]) -> None:
    """Print the times at which a condition on recorded numbers is true, and the recorded rows around each time."""
    several = len({hit.first.env_id for hit in hits}) > 1
    print(f"the condition becomes true {len(hits)} times" if len(hits) != 1 else "the condition becomes true once")
    if not limit:
        return
    if hits and hits[0].around is None:
        rows = [(when(hit.first, several), when(hit.last), str(hit.frames)) for hit in hits[:limit]]
        print_table(("from", "to", "frames"), rows)
    else:
        for hit in hits[:limit]:
            print(f"\n{when(hit.first, several)}" + (f" to {when(hit.last)}" if hit.frames > 1 else ""))
            frames, first, last = hit.around, hit.first.step, hit.last.step
            assert frames is not None
            table = []
            for row in range(len(frames)):
                step = frames.moment(row).step
                inside = step is not None and first is not None and last is not None and first <= step <= last
                cells = (_cell(frames, name, row) for name in frames.table.column_names)
                table.append(("*" if inside else "", *cells))
            print_table(("", *(_named(name, units) for name in frames.table.column_names)), table)
    if len(hits) > limit:
        print(f"… and {len(hits) - limit} more (--limit)")


def print_comparison(found: RecordingComparison, first: Recording, second: Recording, limit: int) -> None:
    """Print how many Rerun entities of two recordings are equal, and when each recorded number first differs."""
    print(f"a: {shown(first.path.absolute())}\nb: {shown(second.path.absolute())}\n")
    if found.is_equal:
        print(f"equal to the last bit: {len(found.equal)} entities")
        return
    rows = [("equal", str(len(found.equal)), ""), ("different", str(len(found.different)), _some(found.different))]
    rows += [("only in a", str(len(found.only_first)), _some(found.only_first))] if found.only_first else []
    rows += [("only in b", str(len(found.only_second)), _some(found.only_second))] if found.only_second else []
    print_table(("entities", "count", ""), rows)
    if first.env_ids != second.env_ids:
        print("they record different environments: " + " and ".join(listed(r.env_ids) for r in (first, second)))
    if found.numbers:
        print("\nnumbers that differ, ordered by their first difference")
        columns = ("number", "differs at", "a", "b", "largest difference", "mean a", "mean b", "std a", "std b")
        print_table(columns, list(map(_difference, found.numbers[:limit])))
        if len(found.numbers) > limit:
            print(f"… and {len(found.numbers) - limit} more (--limit)")


def print_repaired(done: Repaired) -> None:
    """Print which data a damaged recording has lost, and the path of the recording's repaired copy."""
    if done.output is None:
        print(f"{shown(done.path.absolute())} is complete; nothing was written")
        return
    for line in done.health.lines()[1:]:
        print(line)
    print(f"repaired: {shown(done.output.absolute())}\nopen it: {tool('rerun')} {shown(done.output.absolute())}")


def _difference(found: NumberDifference) -> Row:
    at = "number of rows" if found.parting.step is None else when(Moment(found.parting.step, found.parting.time_s))
    values = (found.parting.first, found.parting.second, found.largest)
    sides = (found.first.mean, found.second.mean, found.first.std, found.second.std)
    return (found.name, at, *(number(value) for value in (*values, *sides)))


def _named(name: str, units: Mapping[str, str]) -> str:
    return f"{name} ({units[name]})" if name in units else name


def _cell(frames: Frames, name: str, row: int) -> str:
    value = frames.table.column(name)[row].as_py()
    if name == SIM_TIME:
        return f"{value:.3f}"
    return number(value) if isinstance(value, float) else str(value)


def listed(env_ids: Iterable[int]) -> str:
    """Return environment ids as text."""
    return ", ".join(map(str, env_ids))


def when(moment: Moment | None, with_env: bool = False) -> str:
    """Return a moment as text: time, step, iteration, and with ``with_env`` the environment."""
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
    """Format a number with four significant digits; return a dash for None."""
    return "-" if value is None else "nan" if math.isnan(value) else f"{value:.4g}"


_NOTES = 3  # Print only the last 3 notes of a recording.


def print_summary(summary: Summary, others: Sequence[Path], selection: Selection, status: str | None) -> None:
    """Print tables of a recording's contents and performance figures.

    ``others`` are the other recordings of the run. ``status`` is that of a training; None for ``wheelleg play``.
    """
    print_table(("recording", shown(Path(summary.path).absolute())), _head(summary, status))
    if summary.purpose is None:
        print("\nwheelleg did not write this recording, so there are no figures.")
        parts = [(p.name, f"{p.entities}", f"{p.rows}") for p in summary.parts]
        print_table(("entities below", "count", "rows"), parts)
        return
    title = f"training, iteration {_last_iteration(summary)}, with exploration"
    _section(title, ("figure", "value", "of"), _last(summary))
    environments = f", environment{'s' if len(summary.env_ids) > 1 else ''} {listed(summary.env_ids)}"
    _section("samples of whole episodes" + environments, recorded_headings("samples"), _samples(summary))
    if summary.frames is not None:
        print(f"\n{hanging(f'below: {_scope(summary, selection)}', 0)}")
    _section("episodes", ("figure", "value"), _episodes(summary))
    _section("base", ("", *recorded_headings("base")), _base(summary))
    _section("tracking", ("velocity", *recorded_headings("tracking")), _tracking(summary))
    title = "contact forces: largest in the sensor's history; mean and contact at the end of steps"
    _section(title, ("body", *recorded_headings("contact forces")), _forces(summary))
    efforts: list[Row] = [
        (e.joint, *map(number, (e.rms, e.largest, e.limit)), _share(e.saturated_share)) for e in summary.efforts
    ]
    _section("efforts", ("joint", *recorded_headings("efforts")), efforts)
    ordered = sorted(summary.rewards, key=lambda reward: -(reward.share or 0.0))
    rewards = ((r.term, number(r.weight), number(r.mean), _share(r.share)) for r in ordered)
    _section("rewards", ("term", *recorded_headings("rewards")), rewards)
    events = ((name, f"{count}") for name, count in summary.events.items())
    _section("events", ("event", *recorded_headings("events")), events)
    _section("training, by iteration", ("scalar", *recorded_headings("training")), _training(summary))
    if others:
        print("\n" + hanging("other recordings of this run: " + ", ".join(shown(path) for path in others), 4))


def _section(title: str, columns: Sequence[str], rows: Iterable[Row]) -> None:
    if found := list(rows):
        print(f"\n{title}")
        print_table(columns, found)


def _head(summary: Summary, status: str | None) -> list[Row]:
    own, health = summary.properties.get("wheelleg", {}), summary.health
    spans = summary.timelines
    what = " of ".join(str(word) for word in (summary.purpose or "another tool's", own.get("task")) if word)
    agent = f" ({own['agent']} agent)" if own.get("agent") not in (None, "policy") else ""
    size = f"{health.size / 1e6:.2f} MB, {sum(part.rows for part in summary.parts)} rows of "
    size += f"{sum(part.entities for part in summary.parts)} entities"
    rows: list[Row] = [
        ("what it is", what + agent),
        ("run", status),
        ("size", size),
        ("health", "; ".join(health.lines())),
        *(("note", event.text) for event in summary.notes[-_NOTES:]),
        ("environments", listed(summary.env_ids) if summary.purpose else None),
    ]
    if "sim_time" in spans:
        rows.append(("simulated time", f"{spans['sim_time'].first:.3f} s to {spans['sim_time'].last:.3f} s"))
    named = [name for name in ("step", "iteration") if name in spans]
    rows += [(f"{name}s", f"{spans[name].first:.0f} to {spans[name].last:.0f}") for name in named]
    rows.append(("contents", ", ".join(part.name for part in summary.parts if part.rows or part.name == DOCUMENTS)))
    return [row for row in rows if row[1]]


def _last_iteration(summary: Summary) -> int:
    return max((trend.last_at for trend in summary.training), default=0)


def _last(summary: Summary) -> list[Row]:
    envs = summary.properties.get("wheelleg", {}).get("num_envs")
    found = []
    for trend in summary.training:
        definition = scalar_definition(trend.name)
        place = next((i for i, prefix in enumerate(ENDED_AS) if trend.name.startswith(prefix)), None)
        if definition is None or place is None:
            continue
        of = definition.of.replace("all environments", f"all {envs} environments") if envs else definition.of
        of += "" if trend.last_at == _last_iteration(summary) else f", in iteration {trend.last_at}"
        value = percent(trend.last) if definition.unit == SHARE else _with_unit(trend.last, definition.unit)
        if definition.unit == STEPS and summary.step_dt:
            value += f" ({trend.last * summary.step_dt:.2f} s)"
        found.append((place, (definition.label, value, of)))
    return [row for _, row in sorted(found)]


def _scope(summary: Summary, selection: Selection) -> str:
    """Return a text such as ``all 500 recorded frames``: the frames from which performance figures are computed."""
    frames = "{} of {} recorded frames".format(*summary.frames or (0, 0))
    if summary.sample is None:
        return frames if not selection.is_all else f"all {frames.split()[0]} recorded frames"
    first, last = summary.sample.iteration, summary.sample.last_iteration
    which = "the last sample with a whole episode" if summary.sample.episodes else "the last sample"
    return f"{which}, iterations {first} to {last}: {frames} (--iteration selects others)"


def _episodes(summary: Summary) -> list[Row]:
    f = summary.figures
    if not f.count:
        return []
    cut = [f"{f.begun_before} started before"] * bool(f.begun_before)
    cut += [f"{f.unfinished} not ended"] * bool(f.unfinished)
    label = {key: definition.label for key, definition in RECORDED["episodes"].items()}
    return [
        (label["count"], f"{f.whole} whole" + (f"; left out: {', '.join(cut)}" if cut else "")),
        (label["survival"], share(f.timed_out, f.whole)),
        *((f"{label['ended_by']} {name}", f"{count}") for name, count in f.ended_by.items()),
        (label["mean_duration_s"], _with_unit(f.mean_duration_s, "s")),
        (label["longest_s"], _with_unit(f.longest_s, "s")),
        (label["mean_reward"], number(f.mean_reward)),
    ]


def _samples(summary: Summary) -> Iterator[Row]:
    for s in summary.samples:
        survival = "-" if s.survival is None else share(round(s.survival * s.episodes), s.episodes)
        duration = "-" if s.mean_duration_s is None else f"{s.mean_duration_s:.2f}"
        counts = (f"{s.iteration} to {s.last_iteration}", f"{s.episodes}", f"{s.cut}")
        yield *counts, survival, duration, number(s.mean_reward)


def _base(summary: Summary) -> Iterator[Row]:
    for name, s in summary.base.items():
        values = (s.mean, s.std, s.rms, s.minimum, s.maximum)
        yield f"{name} ({unit(f'base/{name}')})", *map(number, values), when(s.maximum_at)


def _tracking(summary: Summary) -> Iterator[Row]:
    for t in summary.tracking:
        values = map(number, (t.rmse, t.mean, t.largest, t.mean_command))
        yield f"{t.command}.{t.name} ({unit(f'base/{t.name}')})", *values


def _forces(summary: Summary) -> Iterator[Row]:
    for f in summary.forces:
        largest = (number(f.largest_n), when(f.at) if f.largest_n else "")
        yield f"{f.sensor}.{f.body}", *largest, number(f.mean_n), _share(f.contact_share)


def _training(summary: Summary) -> Iterator[Row]:
    for t in summary.training:
        lowest, highest = f"{number(t.lowest)} at {t.lowest_at}", f"{number(t.highest)} at {t.highest_at}"
        yield t.name, number(t.first), number(t.last), lowest, highest


def _with_unit(value: float | None, word: str) -> str:
    return number(value) if value is None or not word else f"{number(value)} {word}"


def _share(value: float | None) -> str:
    return "-" if value is None else percent(value)
