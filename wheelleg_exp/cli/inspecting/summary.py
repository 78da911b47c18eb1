"""How ``wheelleg inspect`` prints what a recording holds and tells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.cli.inspecting.rows import Row, listed, number, when
from wheelleg_exp.cli.printing.figures import shown
from wheelleg_exp.cli.printing.tables import hanging, print_table
from wheelleg_exp.definitions.definition import SHARE, STEPS, percent, share
from wheelleg_exp.definitions.recorded import headings, label
from wheelleg_exp.definitions.training import ENDED_AS, scalar
from wheelleg_exp.inspection.questions.selection import Selection
from wheelleg_exp.inspection.questions.summary import Summary
from wheelleg_exp.recording.layout import DOCUMENTS, unit

_NOTES = 3  # the last of what happened to the recording


def print_summary(summary: Summary, others: Sequence[Path], selection: Selection, status: str | None) -> None:
    """Print what a recording holds, and its figures as tables.

    Args:
        summary: the summary.
        others: the run's other recordings.
        selection: which rows its figures are of.
        status: of the run that it is the training of; None without one.
    """
    print_table(("recording", shown(Path(summary.path).absolute())), _head(summary, status))
    if summary.purpose is None:
        print("\nThis was not recorded by wheelleg: there is no summary of what it tells.")
        print_table(
            ("entities below", "count", "rows"), [(p.name, f"{p.entities}", f"{p.rows}") for p in summary.parts]
        )
        return
    _section(
        f"training, iteration {_last_iteration(summary)}, with exploration", ("figure", "value", "of"), _last(summary)
    )
    _section("samples of whole episodes" + _whose(summary), headings("samples"), _samples(summary))
    if summary.frames is not None:
        print(f"\n{hanging(f'below: {_scope(summary, selection)}', 0)}")
    _section("episodes", ("figure", "value"), _episodes(summary))
    _section("base", ("", *headings("base")), _base(summary))
    _section("tracking", ("velocity", *headings("tracking")), _tracking(summary))
    _section(
        "contact forces: largest in the sensor's history; mean and contact at the end of steps",
        ("body", *headings("contact forces")),
        _forces(summary),
    )
    _section("efforts", ("joint", *headings("efforts")), _efforts(summary))
    _section("rewards", ("term", *headings("rewards")), _rewards(summary))
    _section("events", ("event", *headings("events")), [(name, f"{count}") for name, count in summary.events.items()])
    _section("training, by iteration", ("scalar", *headings("training")), _training(summary))
    if others:
        print("\n" + hanging("other recordings of this run: " + ", ".join(shown(path) for path in others), 4))


def _section(title: str, columns: Sequence[str], rows: Sequence[Row]) -> None:
    if rows:
        print(f"\n{title}")
        print_table(columns, rows)


def _head(summary: Summary, status: str | None) -> list[Row]:
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
        ("environments", listed(summary.env_ids) if summary.purpose else None),
    ]
    if "sim_time" in spans:
        rows.append(("simulated time", f"{spans['sim_time'].first:.3f} s to {spans['sim_time'].last:.3f} s"))
    rows += [
        (f"{name}s", f"{spans[name].first:.0f} to {spans[name].last:.0f}")
        for name in ("step", "iteration")
        if name in spans
    ]
    rows.append(("holds", ", ".join(part.name for part in summary.parts if part.rows or part.name == DOCUMENTS)))
    return [row for row in rows if row[1]]


def _last_iteration(summary: Summary) -> int:
    return max((trend.last_at for trend in summary.training), default=0)


def _last(summary: Summary) -> list[Row]:
    """Return the scalars that tell what a training ended as, each with what it is of."""
    envs = summary.properties.get("wheelleg", {}).get("num_envs")
    found = []
    for trend in summary.training:
        told, place = scalar(trend.name), next((i for i, h in enumerate(ENDED_AS) if trend.name.startswith(h)), None)
        if told is None or place is None:
            continue
        of = told.of.replace("all environments", f"all {envs} environments") if envs else told.of
        of += "" if trend.last_at == _last_iteration(summary) else f", in iteration {trend.last_at}"
        found.append((place, (told.label, _valued(trend.last, told.unit, summary.step_dt), of)))
    return [row for _, row in sorted(found)]


def _valued(value: float, word: str, step_dt: float | None) -> str:
    if word == SHARE:
        return percent(value)
    seconds = f" ({value * step_dt:.2f} s)" if word == STEPS and step_dt else ""
    return f"{_with_unit(value, word)}{seconds}"


def _whose(summary: Summary) -> str:
    return f", environment{'s' if len(summary.env_ids) > 1 else ''} {listed(summary.env_ids)}"


def _scope(summary: Summary, selection: Selection) -> str:
    """Return which frames the figures are of."""
    frames = "{} of {} recorded frames".format(*summary.frames or (0, 0))
    if summary.sample is None:
        return frames if not selection.is_all else f"all {frames.split()[0]} recorded frames"
    first, last = summary.sample.iteration, summary.sample.last_iteration
    which = "the last sample with a whole episode" if summary.sample.episodes else "the last sample"
    return f"{which}, iterations {first} to {last}: {frames} (--iteration chooses others)"


def _episodes(summary: Summary) -> list[Row]:
    f = summary.figures
    if not f.count:
        return []
    cut = [f"{f.begun_before} begun before"] * bool(f.begun_before) + [f"{f.unfinished} not ended"] * bool(f.unfinished)
    return [
        (label("episodes", "count"), f"{f.whole} whole" + (f"; left out: {', '.join(cut)}" if cut else "")),
        (label("episodes", "survival"), share(f.timed_out, f.whole)),
        *((f"{label('episodes', 'ended_by')} {name}", f"{count}") for name, count in f.ended_by.items()),
        (label("episodes", "mean_duration_s"), _with_unit(f.mean_duration_s, "s")),
        (label("episodes", "longest_s"), _with_unit(f.longest_s, "s")),
        (label("episodes", "mean_reward"), number(f.mean_reward)),
    ]


def _samples(summary: Summary) -> list[Row]:
    return [
        (
            f"{s.iteration} to {s.last_iteration}",
            f"{s.episodes}",
            f"{s.cut}",
            "-" if s.survival is None else share(round(s.survival * s.episodes), s.episodes),
            "-" if s.mean_duration_s is None else f"{s.mean_duration_s:.2f}",
            number(s.mean_reward),
        )
        for s in summary.samples
    ]


def _base(summary: Summary) -> list[Row]:
    return [
        (
            f"{name} ({unit(f'base/{name}')})",
            *(number(value) for value in (s.mean, s.std, s.rms, s.minimum, s.maximum)),
            when(s.maximum_at),
        )
        for name, s in summary.base.items()
    ]


def _tracking(summary: Summary) -> list[Row]:
    return [
        (
            f"{t.command}.{t.name} ({unit(f'base/{t.name}')})",
            *(number(value) for value in (t.rmse, t.mean, t.largest, t.mean_command)),
        )
        for t in summary.tracking
    ]


def _forces(summary: Summary) -> list[Row]:
    return [
        (
            f"{f.sensor}.{f.body}",
            number(f.largest_n),
            when(f.at) if f.largest_n else "",
            number(f.mean_n),
            _share(f.contact_share),
        )
        for f in summary.forces
    ]


def _efforts(summary: Summary) -> list[Row]:
    return [
        (e.joint, number(e.rms), number(e.largest), number(e.limit), _share(e.saturated_share)) for e in summary.efforts
    ]


def _rewards(summary: Summary) -> list[Row]:
    ordered = sorted(summary.rewards, key=lambda reward: -(reward.share or 0.0))
    return [(r.term, number(r.weight), number(r.mean), _share(r.share)) for r in ordered]


def _training(summary: Summary) -> list[Row]:
    return [
        (
            t.name,
            number(t.first),
            number(t.last),
            f"{number(t.lowest)} at {t.lowest_at}",
            f"{number(t.highest)} at {t.highest_at}",
        )
        for t in summary.training
    ]


def _with_unit(value: float | None, word: str) -> str:
    return number(value) if value is None or not word else f"{number(value)} {word}"


def _share(value: float | None) -> str:
    return "-" if value is None else percent(value)
