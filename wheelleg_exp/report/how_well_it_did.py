"""How well did it do: the last evaluation on fixed scenarios, beside the reference where it was evaluated too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

from wheelleg_exp.report.blocks import Block, Cell, Code, More, Note, Table, Text
from wheelleg_exp.report.drawings import drawn
from wheelleg_exp.report.subject import Subject
from wheelleg_exp.report.words import capital, moment, number, spoken

_DEGREES = {"rad": "°", "rad/s": "°/s"}
_TITLES = {
    "stand": "Standing",
    "walk": "Following commands",
    "steps": "Steps of the command",
    "push": "Pushes",
    "terrain": "Rough ground",
    "strip": "Onto rough ground and off it",
    "robust": "A changed world",
}
_SHOWN_FIRST = 12  # metrics of a test, before the others are a click away


def evaluated(subject: Subject) -> bool:
    """Return whether the run has been evaluated on the scenarios of a protocol."""
    return _last(subject, "evaluation") is not None


def blocks(subject: Subject) -> list[Block]:
    """Return what the last evaluation found, test by test, with its plots."""
    entry = _last(subject, "evaluation")
    if entry is None:
        return []
    content = _content(subject, entry)
    if content is None:
        return [Note("The files of the last evaluation cannot be read."), *_again(subject, "PROTOCOL")]
    reference = _reference(subject, str(content.get("scenarios_sha256")))
    found: list[Block] = [Text(_about(entry, content, reference is not None))]
    plots = _plots(subject, entry)
    for test, names in groupby(content["metrics"], lambda name: str(name).partition("/")[0]):
        listed = list(names)
        title = _TITLES.get(test, capital(spoken(test)))
        found.append(_table(title, content["metrics"], reference, listed[:_SHOWN_FIRST]))
        found += [drawn(plots[test], f"evaluation-{test}", paired=True)] if test in plots else []
        if rest := listed[_SHOWN_FIRST:]:
            found.append(More(f"More of {title.lower()}", [_table(title, content["metrics"], reference, rest)]))
    found += [Text(entry["results"]["verdict"]) for entry in subject.additions("comparison")[-1:] if _said(entry)]
    return found if reference is not None else [*found, *_again(subject, str(content["protocol"]["name"]))]


def _last(subject: Subject, kind: str) -> Mapping[str, Any] | None:
    """Return the last addition of a kind that holds metrics of a protocol."""
    for entry in reversed(subject.additions(kind)):
        results = entry.get("results")
        if isinstance(results, Mapping) and isinstance(results.get("metrics"), Mapping) and "protocol" in results:
            return entry
    return None


def _file(subject: Subject, entry: Mapping[str, Any], ending: str) -> Path | None:
    names = [name for name in entry.get("files", {}) if str(name).endswith(ending)]
    return subject.file(names[0]) if names else None


def _content(subject: Subject, entry: Mapping[str, Any]) -> dict[str, Any] | None:
    from wheelleg_exp.jobs.evaluate.evaluate import RESULT
    from wheelleg_exp.jobs.evaluate.kept import read_content

    path = _file(subject, entry, f"/{RESULT}")
    return None if path is None or not path.is_file() else read_content(path.parent)


def _reference(subject: Subject, scenarios: str) -> Mapping[str, Any] | None:
    """Return the metrics of the reference controller in the same scenarios; None where there are none."""
    entry = _last(subject, "reference")
    if entry is None or entry["results"].get("scenarios_sha256") != scenarios:
        return None
    found: Mapping[str, Any] = entry["results"]["metrics"]
    return found


def _plots(subject: Subject, entry: Mapping[str, Any]) -> dict[str, Any]:
    from wheelleg_exp.inspection.plots.evaluation import panels
    from wheelleg_exp.jobs.evaluate.evaluate import EPISODES
    from wheelleg_exp.jobs.evaluate.kept import read_episodes

    path = _file(subject, entry, f"/{EPISODES}")
    return {} if path is None or not path.is_file() else panels(read_episodes(path))


def _about(entry: Mapping[str, Any], content: Mapping[str, Any], has_reference: bool) -> str:
    about = content.get("about") or {}
    told = (
        f"Protocol {content['protocol']['name']}, {moment(entry.get('when'))}, checkpoint {content.get('checkpoint')}, "
        f"robot profile {about.get('profile')}; scenarios {str(content['scenarios_sha256'])[:12]}, the same for every "
        "policy. Intervals of 95 % are over episodes: another training seed is not in them."
    )
    return f"{told} The reference is a linear-quadratic controller without noise or delay." if has_reference else told


def _table(title: str, metrics: Mapping[str, Any], reference: Mapping[str, Any] | None, names: list[str]) -> Table:
    columns = ("Metric", "Value", "95 % interval", *(("Reference",) if reference is not None else ()))
    return Table(title, columns, [_row(name, metrics[name], reference) for name in names])


def _row(name: str, figure: Mapping[str, Any], reference: Mapping[str, Any] | None) -> list[Cell]:
    unit = str(figure.get("unit") or "")
    factor = 180.0 / math.pi if unit in _DEGREES else 1.0
    unit = _DEGREES.get(unit, unit)
    ends = [_scaled(figure.get(end), factor) for end in ("low", "high")]
    value = _scaled(figure.get("value"), factor)
    told = f"{value}{'' if unit.startswith('°') or not unit else ' '}{unit}" if value != "–" else value
    cells = [
        Cell(capital(spoken(name.partition("/")[2]))),
        Cell(told, number=True),
        Cell("–" if "–" in ends else " to ".join(ends), number=True),
    ]
    return cells if reference is None else [*cells, Cell(_scaled(reference.get(name), factor), number=True)]


def _scaled(value: Any, factor: float) -> str:
    return number(factor * value) if isinstance(value, (int, float)) and not isinstance(value, bool) else "–"


def _said(entry: Mapping[str, Any]) -> bool:
    results = entry.get("results")
    return isinstance(results, Mapping) and bool(results.get("verdict"))


def _again(subject: Subject, protocol: str) -> list[Block]:
    return [Code(f"wheelleg evaluate {subject.id} protocol={protocol} --reference", "Beside the reference controller:")]
