"""Does it stand: the figures of plays and evaluations, and what the last play's recording shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.definitions.rollout import MOTION, label, window
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.report.blocks import Beside, Block, Cell, Code, More, Note, Table, Text
from wheelleg_exp.report.does_it_stand import ended, played, tone_of
from wheelleg_exp.report.drawings import drawn
from wheelleg_exp.report.subject import AGENT, Subject
from wheelleg_exp.report.what_was_measured import Measured, measured
from wheelleg_exp.report.words import brief, capital, counted, moment, number, numbers, percent, spoken

if TYPE_CHECKING:
    from wheelleg_exp.inspection.plots.plots import Plot
    from wheelleg_exp.inspection.plots.style import Panel
    from wheelleg_exp.recording.reading.reader import Recording

_WORDS: Mapping[str, Callable[[Any], str]] = {
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
_TOLD = ("settle_s", "settled_episodes", "settled_steps", "ended_by", "non_finite")  # told elsewhere
_OF_PLAY = ("checkpoint", "checkpoint_sha256", "seed", "overrides")
_PLAYS_SHOWN = 12
_FIRST = ("Height", "Pitch")  # the panels of the tracking plot that tell whether it stands


def blocks(subject: Subject) -> list[Block]:
    """Return the tables of what was played and evaluated; where nothing was, how to do it."""
    figures = played(subject)
    found: list[Block] = [*_evaluations(subject)]
    if figures:
        found.append(Beside([_figures(subject, figures), *_endings(figures)]))
        found += _settled(figures)
    elif subject.status != AGENT:
        found.append(Note("The policy has not been played, so these are only the figures of its training.", ""))
        found.append(Code(f"wheelleg play {subject.id}", "To see how it stands without exploration noise:"))
    return [*found, *_plays(subject)]


def recording_of_play(subject: Subject) -> Path | None:
    """Return the recording of the last play, or of the agent's run."""
    if subject.status == AGENT:
        return subject.file("recording.rrd")
    for entry in reversed(subject.additions("play")):
        names = [name for name in entry.get("files", {}) if name.endswith(".rrd")]
        return subject.file(names[0]) if names else None
    return None


def motion(recording: Recording) -> list[Block]:
    """Return the curves of a play's recording: height and pitch at once; velocities, forces and joints on demand."""
    from wheelleg_exp.inspection.plots.plots import PLOTS

    tracking = _panels(PLOTS["tracking"], recording)
    first = [panel for panel in tracking if panel.title.startswith(_FIRST)]
    rest = [panel for panel in tracking if panel not in first]
    tables = _measured(recording)
    groups = [
        ("Velocities and tilt", rest, tables.tracking),
        ("Contact forces", _panels(PLOTS["contact_forces"], recording), tables.forces),
        ("Joints", _panels(PLOTS["joints"], recording), tables.efforts),
    ]
    found: list[Block] = list(tables.scope)
    found += [drawn(first, "play")] if first else []
    for i, (title, panels, measures) in enumerate(groups):
        shown = [*measures, *([drawn(panels, f"play-{i}", paired=title == "Joints")] if panels else [])]
        found += [More(title, shown)] if shown else []
    return found


def _measured(recording: Recording) -> Measured:
    try:
        return measured(recording)
    except RunDirectoryError:
        return Measured()


def _panels(plot: Plot, recording: Recording) -> list[Panel]:
    """Return a plot's panels, none where the recording lacks what they need."""
    try:
        return plot.each(recording)
    except RunDirectoryError:
        return []


def _figures(subject: Subject, figures: Mapping[str, Any]) -> Table:
    settle_s = figures.get("settle_s")
    rows = [
        [
            Cell(capital(label(key, settle_s) + group)),
            Cell(words(value), number=True, tone=tone_of(value) if key == "survival" else ""),
            Cell(_of(key, figures)),
        ]
        for key, words in _WORDS.items()
        if key in figures and not (key == "unfinished" and not figures[key])
        for group, value in _by_group(figures[key])
    ]
    others = [key for key in figures if key not in (*_WORDS, *_TOLD, *_OF_PLAY)]
    rows += [[Cell(capital(spoken(str(key)))), Cell(number(figures[key]), number=True), Cell("")] for key in others]
    return Table("The agent" if subject.status == AGENT else "The last play", ("Figure", "Value", "Of"), rows)


def _by_group(value: Any) -> list[tuple[str, Any]]:
    """Return a figure's values, each with what stands behind the label: the actuator group where it has several."""
    return [(f" ({group})", each) for group, each in value.items()] if isinstance(value, Mapping) else [("", value)]


def _of(key: str, figures: Mapping[str, Any]) -> str:
    """Return what a figure is of, as far as the play tells."""
    if key == "episodes":
        return "the first of each environment"
    if key in ("survival", "mean_return"):
        count = ended(figures)
        return "" if count is None else counted(count, "ended episode")
    steps, settled = figures.get("settled_steps"), figures.get("settled_episodes")
    if key in ("drift_m", "yaw_drift_deg"):
        return counted(settled, "episode") if isinstance(settled, int) else ""
    if (
        not (key.startswith(("height_", "pitch_")) or key in MOTION)
        or not isinstance(steps, int)
        or not isinstance(settled, int)
    ):
        return ""
    return f"{counted(steps, 'step')} of {counted(settled, 'episode')}"


def _settled(figures: Mapping[str, Any]) -> list[Block]:
    """Return why there is no height and no pitch, where there is none."""
    if figures.get("pitch_rms_deg", 0.0) is not None:
        return []
    return [Text("Height and pitch count once an episode has settled; none lasted that long.")]


def _endings(figures: Mapping[str, Any]) -> list[Block]:
    endings, count = figures.get("ended_by"), ended(figures)
    if not isinstance(endings, Mapping) or not count:
        return []
    counts = {str(name): times for name, times in endings.items() if isinstance(times, int)}
    rows = [
        [Cell(spoken(name)), Cell(number(times), number=True), Cell(percent(times / count), bar=times / count)]
        for name, times in counts.items()
    ]
    twice = " (what two terminations ended counts for both)" if sum(counts.values()) > count else ""  # older plays
    title = f"How its {counted(count, 'ended episode')} ended{twice}"
    return [Table(title, ("Ended by", "Episodes", "Share"), rows)]


def _plays(subject: Subject) -> list[Block]:
    """Return one row a play, when there was more than one."""
    plays = subject.additions("play")[-_PLAYS_SHOWN:]
    if len(plays) < 2:
        return []
    rows = [[Cell(moment(entry.get("when"))), *_play_row(numbers(entry.get("results") or {}))] for entry in plays]
    columns = (
        "When",
        "Checkpoint",
        "Changed",
        "Episodes",
        "Survival",
        "Height RMSE",
        "Pitch RMS",
        "Of",
        "Return, mean",
    )
    return [Table("All plays", columns, rows)]


def _play_row(results: Mapping[str, Any]) -> list[Cell]:
    changed = " ".join(str(text) for text in results.get("overrides") or []) or "–"
    told = [_WORDS[key](results.get(key)) for key in ("episodes", "survival", "height_rmse_m", "pitch_rms_deg")]
    cells = [
        Cell(text, number=True) for text in [*told, window(results.get("settle_s")), number(results.get("mean_return"))]
    ]
    return [Cell(str(results.get("checkpoint", "–")), code=True), Cell(changed, code=True), *cells]


def _evaluations(subject: Subject) -> list[Block]:
    """Return the figures of the last evaluation that is none of a protocol, as they were recorded."""
    entries = [one for one in subject.additions("evaluation") if "protocol" not in (one.get("results") or {})]
    results = entries[-1].get("results") if entries else None
    if not isinstance(results, Mapping) or not results:
        return []
    rows = [[Cell(spoken(name)), Cell(number(value), number=True)] for name, value in _flat(numbers(results))]
    return [Table(f"Evaluation of {moment(entries[-1].get('when'))}", ("Figure", "Value"), rows)]


def _flat(results: Mapping[str, Any], head: str = "") -> list[tuple[str, Any]]:
    found: list[tuple[str, Any]] = []
    for name, value in results.items():
        label = f"{head}{name}"
        if isinstance(value, Mapping):
            found += _flat(value, f"{label}: ")
        else:
            found.append((label, value if not isinstance(value, (list, tuple)) else brief(value)))
    return found


def _scaled(value: Any, factor: float, unit: str) -> str:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return number(value)
    return f"{number(float(value) * factor)}{'' if unit == '°' else ' '}{unit}"
