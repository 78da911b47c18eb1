"""Compile, render, and write the page of a report.

If one section fails, its place shows the error and the other sections stay. A report overwrites only an earlier
report of the same run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from wheelleg_exp import __version__
from wheelleg_exp.errors import RunDirectoryError, WheellegError, printable
from wheelleg_exp.files import for_people, sha256, write_text
from wheelleg_exp.report import headline
from wheelleg_exp.report import performance_section as evaluation
from wheelleg_exp.report import performance_section as standing
from wheelleg_exp.report import provenance_section as surroundings
from wheelleg_exp.report import provenance_section as trust
from wheelleg_exp.report import settings_section as settings
from wheelleg_exp.report import training_section as learning
from wheelleg_exp.report import training_section as objective
from wheelleg_exp.report.page_blocks import Block, Note, Page, Section
from wheelleg_exp.report.pictures_section import Look
from wheelleg_exp.report.report_subject import AGENT, KIND, Subject
from wheelleg_exp.report.value_format import whole_units
from wheelleg_exp.run.run_list import non_finite_note

# Marks a file as the report of a run, so that a later report can overwrite it.
MARK = '<meta name="wheelleg-report" content="'


def render_page(page: Page) -> str:
    """Return the HTML file as text.

    No value can run a script: the templates escape all values, and the page's content security policy forbids scripts
    and external resources.
    """
    environment = Environment(
        loader=PackageLoader("wheelleg_exp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    environment.filters["drawn"] = Markup  # only for SVG from `inline_svg.clean`, and for the style sheet
    style = environment.get_template("report.css").render()
    return environment.get_template("report.html").render(page=page, style=style, mark=MARK)


def _visible(value: Any) -> Any:
    """Make invisible control characters visible, and replace characters that HTML cannot hold."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return printable(value)


NAME = "report.html"
_HEAD = 4096  # bytes that contain the mark


@dataclass(frozen=True)
class Written:
    """A written report: its path, its size in bytes, and whether the run's manifest lists it."""

    path: Path
    size: int
    recorded: bool


def report_path(subject: Subject, output: Path | None) -> Path:
    """Return the path of the report.

    Raises:
        RunDirectoryError: another file has that path, or nothing can be written there.
    """
    path = subject.path / NAME if output is None else output
    if path.is_dir():
        raise RunDirectoryError(f"'{path}' is a folder", expected="the name of a file, such as report.html")
    if (path.exists() or path.is_symlink()) and not (_is_report(path, subject.id) or _is_own(subject, path)):
        raise RunDirectoryError(
            f"'{path}' exists and is not a report of this run, so it is not overwritten",
            expected="-o with another name",
        )
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    with for_people(path), tempfile.TemporaryFile(dir=folder):  # fail now if the folder cannot be written
        return path


def write_report(subject: Subject, path: Path, html: str, command: Sequence[str]) -> Written:
    """Write the page, and record it in the manifest if it is in the run directory.

    Raises:
        WheellegError: the page cannot be written.
    """
    write_text(path, html)
    inside = subject.run is not None and path.resolve().is_relative_to(subject.path.resolve())
    if subject.run is not None and inside and not _recorded(subject, path):
        subject.run.manifest().add(KIND, [path], command=command)
    return Written(path, path.stat().st_size, inside)


def _is_report(path: Path, run: str) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    with for_people(path, "read"), path.open("rb") as file:
        head = file.read(_HEAD).decode("utf-8", errors="replace")
    return f'{MARK}{escape(run)}">' in head


def _is_own(subject: Subject, path: Path) -> bool:
    """Return whether the run's manifest lists the file as its report, even if the run was renamed."""
    inside = not path.is_symlink() and path.is_file() and path.resolve().is_relative_to(subject.path.resolve())
    return inside and _recorded(subject, path)


def _recorded(subject: Subject, path: Path) -> bool:
    """Return whether the manifest already lists this file with this content."""
    name = path.resolve().relative_to(subject.path.resolve()).as_posix()
    entries = [entry["files"][name] for entry in subject.additions(KIND) if name in entry.get("files", {})]
    return bool(entries) and entries[-1]["sha256"] == sha256(path)


T = TypeVar("T")
Builder = Callable[[], Sequence[Block]]


def compile_page(subject: Subject, look: Look, verdict: trust.Verdict) -> Page:
    """Return the page."""
    of_training = subject.status != AGENT
    sections = [
        section(
            "standing",
            "Does it stand?",
            _or(lambda: _lead(subject), ""),
            lambda: standing.performance_blocks(subject),
            look.of_play,
        ),
        *(_of_evaluation(subject) if of_training else []),
        *(_of_training(subject, look, verdict) if of_training else []),
        section("settings", "What was set", _SETTINGS, lambda: settings.settings_blocks(subject)),
        *(_rest(subject) if of_training else []),
    ]
    return Page(
        run=subject.id,
        task=subject.task,
        status=subject.status,
        tone=headline.tone(subject),
        sentence=_or(
            lambda: whole_units(headline.sentence(subject)),
            "The outcome of this run is unknown: its manifest is damaged.",
        ),
        cards=_or(lambda: headline.cards(subject, verdict.card), [verdict.card] if verdict.card else []),
        facts=_or(lambda: headline.facts(subject), []),
        command=_or(lambda: headline.command(subject), ""),
        hero=_or(look.hero, None),
        notes=[Note(problem) for problem in dict.fromkeys([*_not_finite(subject), *subject.problems])],
        sections=sections,
        version=__version__,
    )


def _not_finite(subject: Subject) -> list[str]:
    """Return notes on NaN and inf in the training and in its last play."""
    trained = _or(lambda: non_finite_note(subject.manifest.get("results") or {}), None)
    played = _or(lambda: non_finite_note(headline.played(subject)), None)
    return [f"{what}: {note}" for what, note in (("The training", trained), ("The last rollout", played)) if note]


_SETTINGS = "The values that differ from the task's defaults, and who set them."


def _lead(subject: Subject) -> str:
    if subject.status == AGENT:
        return "Figures of these actions, over the first episode of each environment."
    if headline.played(subject):
        return "Figures of the policy without exploration noise, over the first episode of each environment."
    return ""


def _of_evaluation(subject: Subject) -> list[Section]:
    if not _or(lambda: evaluation.evaluated(subject), False):
        return []
    return [section("evaluation", "How well did it do?", "", lambda: evaluation.evaluation_blocks(subject))]


def _of_training(subject: Subject, look: Look, verdict: trust.Verdict) -> list[Section]:
    return [
        section(
            "learning",
            "How it learned",
            "",
            lambda: learning.first_curves(subject),
            look.of_training,
            lambda: learning.more_curves(subject),
        ),
        section("objective", "What it optimises", "", lambda: objective.reward_blocks(subject)),
        section("trust", "Can it be trusted and repeated?", "", verdict.blocks),
    ]


def _rest(subject: Subject) -> list[Section]:
    return [
        section(
            "source",
            "Source, machine and robot",
            "",
            lambda: surroundings.source(subject),
            lambda: surroundings.machine(subject),
            lambda: surroundings.robot(subject),
        ),
        section("files", "Files", "", lambda: surroundings.resumes(subject), lambda: surroundings.files(subject)),
    ]


def section(name: str, title: str, lead: str, *builders: Builder) -> Section:
    """Return a section of the page. A part that fails becomes one sentence."""
    return Section(name, title, lead, [block for builder in builders for block in _tried(builder)])


def _tried(builder: Builder) -> Sequence[Block]:
    """Return a part's blocks; one sentence if the part fails."""
    try:
        return builder()
    except WheellegError as error:
        return [Note(f"This part cannot be shown: {error}.")]
    except Exception as error:  # damaged files can raise any error
        return [Note(f"This part cannot be shown: {type(error).__name__}: {error}.")]


def _or(build: Callable[[], T], instead: T) -> T:
    """Return the result of ``build``; if it fails, return ``instead``."""
    try:
        return build()
    except Exception:
        return instead
