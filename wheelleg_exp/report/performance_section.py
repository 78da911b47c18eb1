"""Report sections on performance: figures of plays, measures of the last play's recording, and evaluations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby

from wheelleg_exp.definitions import MOTION, recorded_headings, rollout_label, settled_window
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.inspection.episode_measures import EffortUse, ForceExtreme, TrackingError
from wheelleg_exp.inspection.plot_data import Source
from wheelleg_exp.inspection.plot_style import Panel
from wheelleg_exp.inspection.recording_plots import PLOTS
from wheelleg_exp.inspection.recording_summary import Summary, summarize
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.report.headline import ended, played, settle_s, tone_of
from wheelleg_exp.report.page_blocks import Beside, Block, Cell, Code, More, Note, Table, Text, Tone
from wheelleg_exp.report.plot_images import drawn
from wheelleg_exp.report.report_subject import AGENT, Subject, is_number
from wheelleg_exp.report.value_format import capital, counted, exact, moment, number, numbers, percent, spoken
from wheelleg_exp.run.records import Addition

_UNITS = {"v_x": "m/s", "v_y": "m/s", "w_z": "rad/s"}
_NOTES = 3
_HIGH, _FULL = 0.01, 0.1  # Mark a joint yellow if it is at its effort limit for 1 % of the time, red for 10 %.


def _scope(found: Summary) -> list[Block]:
    steps, count = (found.frames or (0, 0))[0], found.figures.count
    which = ", ".join(map(str, found.env_ids))
    many = len(found.env_ids) > 1
    whose = f"The curves are of environment {found.env_ids[0]}, the tables of environments {which}" if many else ""
    whose = whose or f"The curves and tables are of environment {which} alone"
    return [Text(f"{whose}: all {counted(steps, 'recorded step')}, of {counted(count, 'episode')}.")] if steps else []


def health(recording: Recording) -> list[Block]:
    """Return sentences about the missing and the repaired parts of a recording; empty for a complete recording."""
    notes = [Note(f"Of the recording: {event.text}.") for event in recording.events("recording")[-_NOTES:]]
    if recording.health.is_whole:
        return list(notes)
    what = "; ".join(line.rstrip(". ") for line in recording.health.lines())
    repair = "'wheelleg inspect --repair' writes a copy with the readable part that opens everywhere"
    return [Note(f"The recording is {what}. The readable part is shown; {repair}."), *notes]


def _tracking(errors: Sequence[TrackingError]) -> list[Block]:
    rows = []
    for error in errors:
        unit = _UNITS.get(error.name, "")
        texts = [f"{number(value)} {unit}".strip() for value in (error.rmse, error.mean, error.largest)]
        rows.append([Cell(error.name, code=True), *(Cell(text, number=True) for text in texts)])
    columns = ("Velocity", *map(capital, recorded_headings("tracking", "rmse", "mean", "largest")))
    return [Table("Velocities against their commands", columns, rows)] if rows else []


def _forces(forces: Sequence[ForceExtreme]) -> list[Block]:
    touched = [force for force in forces if force.contact_share > 0]
    rows = [
        [Cell(f.body, code=True), *_numbers(f.mean_n, f.largest_n), Cell(percent(f.contact_share), bar=f.contact_share)]
        for f in touched
    ]
    columns = ("Body", *map(capital, recorded_headings("contact forces", "mean_n", "largest_n", "contact_share")))
    what = "mean and contact at the end of steps, largest in the sensor's history"
    return [Table(f"Contact forces of the bodies that touched something: {what}", columns, rows)] if rows else []


def _efforts(efforts: Sequence[EffortUse]) -> list[Block]:
    rows = []
    for use in efforts:
        share = use.saturated_share
        tone: Tone = "" if share is None or share < _HIGH else "warn" if share < _FULL else "bad"
        ends = [Cell(exact(use.limit), number=True), Cell(percent(share), bar=share, tone=tone)]
        rows.append([Cell(use.joint, code=True), *_numbers(use.rms, use.largest), *ends])
    columns = ("Joint", *map(capital, recorded_headings("efforts")))
    return [Table("Efforts of the joints", columns, rows)] if rows else []


def _numbers(*values: float) -> list[Cell]:
    return [Cell(number(value), number=True) for value in values]


_FORMATS: Mapping[str, Callable[[object], str]] = {
    "episodes": number,
    "unfinished": number,
    "survival": percent,
    "height_rmse_m": lambda v: _scaled(v, 1e3, "mm"),
    "height_mean_m": lambda v: _scaled(v, 1e3, "mm"),
    "pitch_rms_deg": lambda v: _scaled(v, 1.0, "°"),
    "pitch_mean_deg": lambda v: _scaled(v, 1.0, "°"),
    "mean_return": number,
    "drift_m": lambda v: _scaled(v, 1e3, "mm"),
    "yaw_drift_deg": lambda v: _scaled(v, 1.0, "°"),
    "action_rate_per_s": lambda v: _scaled(v, 1.0, "/s"),
    "power_net_w": lambda v: _scaled(v, 1.0, "W"),
    "torque_rms_nm": lambda v: _scaled(v, 1.0, "N·m"),
    "at_limit": percent,
    "sign_changes_per_s": lambda v: _scaled(v, 1.0, "/s"),
}
_SHOWN_ELSEWHERE = ("settle_s", "settled_episodes", "settled_steps", "ended_by", "non_finite")
_OF_PLAY = ("checkpoint", "checkpoint_sha256", "seed", "overrides")
_PLAYS_SHOWN = 12
_FIRST = ("Height", "Pitch")  # Plots of height and pitch are first, because they show whether the robot is upright.


def performance_blocks(subject: Subject) -> list[Block]:
    """Return the report's tables of plays; without a play, return the command that plays the policy."""
    figures = played(subject)
    found: list[Block] = []
    if figures:
        found.append(Beside([_figures(subject, figures), *_endings(figures)]))
        if figures.get("pitch_rms_deg", 0.0) is None:
            found.append(Text("Height and pitch are measured after settling; no episode lasted that long."))
    elif subject.status != AGENT:
        found.append(Note("The policy has not been played, so these are only the figures of its training.", ""))
        found.append(Code(f"wheelleg play {subject.id}", "To see how it stands without exploration noise:"))
    plays = subject.additions("play")[-_PLAYS_SHOWN:]
    if len(plays) > 1:
        rows = []
        for entry in plays:
            results = numbers(entry.results)
            overrides = results.get("overrides")
            changed = " ".join(map(str, overrides)) if isinstance(overrides, list) and overrides else "–"
            names = (str(results.get("checkpoint", "–")), changed)
            keys = ("episodes", "survival", "height_rmse_m", "pitch_rms_deg")
            texts = [_FORMATS[key](results.get(key)) for key in keys]
            texts += [settled_window(settle_s(results)), number(results.get("mean_return"))]
            cells = [Cell(name, code=True) for name in names] + [Cell(text, number=True) for text in texts]
            rows.append([Cell(moment(entry.when)), *cells])
        columns = ("When", "Checkpoint", "Changed", "Episodes", "Survival", "Height RMSE", "Pitch RMS")
        found.append(Table("All plays", (*columns, "Of", "Return, mean"), rows))
    return found


def motion(recording: Recording) -> list[Block]:
    """Return the curves of a play's recording: height and pitch open; velocities, forces, and joints collapsed."""
    tracking = _panels("tracking", recording)
    first = [panel for panel in tracking if panel.title.startswith(_FIRST)]
    rest = [panel for panel in tracking if panel not in first]
    try:
        summary = summarize(recording)
    except RunDirectoryError:  # Damaged data: show the curves without tables.
        summary = None
    groups = [
        ("Velocities and tilt", rest, _tracking(summary.tracking) if summary else []),
        ("Contact forces", _panels("contact_forces", recording), _forces(summary.forces) if summary else []),
        ("Joints", _panels("joints", recording), _efforts(summary.efforts) if summary else []),
    ]
    found: list[Block] = _scope(summary) if summary else []
    found += [drawn(first)] if first else []
    for title, panels, measures in groups:
        shown = [*measures, *([drawn(panels, paired=title == "Joints")] if panels else [])]
        found += [More(title, shown)] if shown else []
    return found


def _panels(name: str, recording: Recording) -> list[Panel]:
    try:
        return PLOTS[name].panels(Source(recording))
    except RunDirectoryError:  # The recording lacks the data that the plot ``name`` needs.
        return []


def _figures(subject: Subject, figures: Mapping[str, object]) -> Table:
    rows = [
        [
            Cell(capital(rollout_label(key, settle_s(figures)) + group)),
            Cell(words(value), number=True, tone=tone_of(value) if key == "survival" and is_number(value) else ""),
            Cell(_of(key, figures)),
        ]
        for key, words in _FORMATS.items()
        if key in figures and not (key == "unfinished" and not figures[key])
        for group, value in _by_group(figures[key])
    ]
    others = [key for key in figures if key not in (*_FORMATS, *_SHOWN_ELSEWHERE, *_OF_PLAY)]
    rows += [[Cell(capital(spoken(str(key)))), Cell(number(figures[key]), number=True), Cell("")] for key in others]
    return Table("The agent" if subject.status == AGENT else "The last play", ("Figure", "Value", "Of"), rows)


def _by_group(value: object) -> list[tuple[str, object]]:
    return [(f" ({group})", each) for group, each in value.items()] if isinstance(value, Mapping) else [("", value)]


def _of(key: str, figures: Mapping[str, object]) -> str:
    if key == "episodes":
        return "the first of each environment"
    if key in ("survival", "mean_return"):
        count = ended(figures)
        return "" if count is None else counted(count, "ended episode")
    steps, settled = figures.get("settled_steps"), figures.get("settled_episodes")
    if key in ("drift_m", "yaw_drift_deg"):
        return counted(settled, "episode") if isinstance(settled, int) else ""
    if (key.startswith(("height_", "pitch_")) or key in MOTION) and isinstance(steps, int) and isinstance(settled, int):
        return f"{counted(steps, 'step')} of {counted(settled, 'episode')}"
    return ""


def _endings(figures: Mapping[str, object]) -> list[Block]:
    endings, count = figures.get("ended_by"), ended(figures)
    if not isinstance(endings, Mapping) or not count:
        return []
    counts = {str(name): times for name, times in endings.items() if isinstance(times, int)}
    rows = [
        [Cell(spoken(name)), Cell(number(times), number=True), Cell(percent(times / count), bar=times / count)]
        for name, times in counts.items()
    ]
    # Old versions of ``wheelleg play`` counted an episode once for each termination term that ended the episode.
    twice = " (an episode with two terminations counts for both)" if sum(counts.values()) > count else ""
    return [Table(f"How its {counted(count, 'ended episode')} ended{twice}", ("Ended by", "Episodes", "Share"), rows)]


def _scaled(value: object, factor: float, unit: str) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return number(value)
    return f"{number(float(value) * factor)}{'' if unit == '°' else ' '}{unit}"


_DEGREES = {"rad": "°", "rad/s": "°/s"}
_TITLES = {"stand": "Standing", "walk": "Following commands", "steps": "Steps of the command", "push": "Pushes"}
_TITLES |= {"height": "Commanded heights", "jump": "Jumps", "bump": "Jumps after bumps", "get_up": "Getting up"}
_TITLES |= {"terrain": "Rough ground", "strip": "Onto rough ground and off it", "robust": "A changed world"}
_SHOWN_FIRST = 12  # For each evaluation test, the report shows the first 12 metrics and collapses the others.


def evaluation_blocks(subject: Subject) -> list[Block]:
    """Return blocks with the results of a run's last evaluation, test by test, and with the evaluation's plots."""
    entry = _last(subject, "evaluation")
    if entry is None:
        return []
    from wheelleg_exp.inspection.evaluation_plots import panels
    from wheelleg_exp.jobs.saved_evaluation import EPISODES, RESULT, margins_of, read_content, read_episodes

    recorded = list(entry.files)
    files = {kind: next((n for n in recorded if n.endswith(f"/{kind}")), None) for kind in (RESULT, EPISODES)}
    result, episodes = (subject.file(files[kind] or "") for kind in (RESULT, EPISODES))
    if result is None:
        return [Note("The files of the last evaluation cannot be read."), *_repeat_command(subject, "PROTOCOL")]
    content = read_content(result.parent)
    # Compare the policy with the reference controller only if both were evaluated in the same scenarios.
    other = _last(subject, "reference")
    is_same = other is not None and other.results.get("scenarios_sha256") == str(content.get("scenarios_sha256"))
    reference = _metrics(other) if other is not None and is_same else None
    about = content.get("about") or {}
    text = (
        f"Protocol {content['protocol']['name']}, {moment(entry.when)}, checkpoint {content.get('checkpoint')}, "
        f"robot profile {about.get('profile')}, engine {about.get('engine', 'mujoco')}; scenarios "
        f"{str(content['scenarios_sha256'])[:12]}, the same for every policy. Intervals of 95 % are over episodes, not "
        "over training seeds."
    )
    if reference is not None:
        text += " The reference is a linear-quadratic controller without noise or delay."
    found: list[Block] = [Text(text)]
    plots = {} if episodes is None else panels(read_episodes(episodes))
    for test, names in groupby(content["metrics"], lambda name: str(name).partition("/")[0]):
        listed = list(names)
        title = _TITLES.get(test, capital(spoken(test)))
        found.append(_table(title, content["metrics"], reference, listed[:_SHOWN_FIRST]))
        found += [drawn(plots[test], paired=True)] if test in plots else []
        if rest := listed[_SHOWN_FIRST:]:
            found.append(More(f"More of {title.lower()}", [_table(title, content["metrics"], reference, rest)]))
    if margins := margins_of(subject.manifest.additions):
        rows = [
            [Cell(f"{capital(name)}, {unit}"), Cell(number(policy), number=True), Cell(number(other), number=True)]
            for name, unit, policy, other in margins
        ]
        found.append(Table("Largest survived change", ("Change", "Policy", "Reference"), rows))
    compared = [entry.results for entry in subject.additions("comparison")]
    found += [Text(str(r["verdict"])) for r in compared[-1:] if r.get("verdict") and not _in_engines(r)]
    for blocks in {str(r.get("protocol")): blocks for r in compared if (blocks := _in_engines(r))}.values():
        found += blocks
    return found if reference is not None else [*found, *_repeat_command(subject, str(content["protocol"]["name"]))]


def _in_engines(results: Mapping[str, object]) -> list[Block]:
    """Return the metrics of the same policies in two engines; [] if a comparison is not of two engines."""
    engines, metrics = results.get("engines"), results.get("metrics")
    if not (isinstance(engines, list) and isinstance(metrics, Mapping)):
        return []
    rows = []
    for name, row in metrics.items():
        if isinstance(row, list) and len(row) == 3:
            factor, unit = _in_degrees(str(row[2]))
            values = (Cell(_scaled_figure(value, factor), number=True) for value in row[:2])
            rows.append([Cell(name, code=True), *values, Cell(unit)])
    title = f"In two engines: {spoken(str(results.get('protocol')))}, runs: {number(results.get('runs'))}"
    table = Table(title, ("Metric", *map(str, engines), "Unit"), rows)
    return [table, Text(str(results.get("verdict")))]


def _metrics(entry: Addition) -> Mapping[str, object] | None:
    found = entry.results.get("metrics")
    return found if isinstance(found, Mapping) else None


def _last(subject: Subject, kind: str) -> Addition | None:
    entries = (entry for entry in reversed(subject.additions(kind)) if "protocol" in entry.results)
    return next((entry for entry in entries if _metrics(entry) is not None), None)


def _table(
    title: str, metrics: Mapping[str, Mapping[str, object]], reference: Mapping[str, object] | None, names: list[str]
) -> Table:
    columns = ("Metric", "Value", "95 % interval", *(("Reference",) if reference is not None else ()))
    return Table(title, columns, [_row(name, metrics[name], reference) for name in names])


def _row(name: str, figure: Mapping[str, object], reference: Mapping[str, object] | None) -> list[Cell]:
    factor, unit = _in_degrees(str(figure.get("unit") or ""))
    ends = [_scaled_figure(figure.get(end), factor) for end in ("low", "high")]
    value = _scaled_figure(figure.get("value"), factor)
    shown = f"{value}{'' if unit.startswith('°') or not unit else ' '}{unit}" if value != "–" else value
    between = "–" if "–" in ends else "" if ends == [value, value] else " to ".join(ends)
    cells = [Cell(capital(spoken(name.partition("/")[2]))), Cell(shown, number=True), Cell(between, number=True)]
    return cells if reference is None else [*cells, Cell(_scaled_figure(reference.get(name), factor), number=True)]


def _in_degrees(unit: str) -> tuple[float, str]:
    """Return the factor and the unit with which the report shows a metric: angles are in degrees."""
    return (180.0 / math.pi, _DEGREES[unit]) if unit in _DEGREES else (1.0, unit)


def _scaled_figure(value: object, factor: float) -> str:
    return number(factor * value) if isinstance(value, (int, float)) and not isinstance(value, bool) else "–"


def _repeat_command(subject: Subject, protocol: str) -> list[Block]:
    command = f"wheelleg evaluate {subject.id} protocol={protocol} --reference"
    return [Code(command, "Compare with the reference controller:")]
