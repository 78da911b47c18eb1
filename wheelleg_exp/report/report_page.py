"""Assemble, render, and write the HTML page of a report.

A section that cannot be built shows the error. Only an earlier report of the same run is overwritten.
"""

from __future__ import annotations

import re
import shlex
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from wheelleg_exp import __version__
from wheelleg_exp.errors import RunDirectoryError, WheellegError, printable
from wheelleg_exp.files import for_people, sha256, write_text
from wheelleg_exp.report import headline
from wheelleg_exp.report import performance_section as standing
from wheelleg_exp.report import provenance_section as provenance
from wheelleg_exp.report import settings_section as settings
from wheelleg_exp.report import training_section as learning
from wheelleg_exp.report.page_blocks import Block, Note, Page, Section
from wheelleg_exp.report.pictures_section import Look
from wheelleg_exp.report.provenance_section import Verdict
from wheelleg_exp.report.report_subject import AGENT, KIND, Subject
from wheelleg_exp.run.run_list import non_finite_note

# A report page contains ``MARK`` and the run's id, so that only a later report of this run overwrites the page.
MARK = '<meta name="wheelleg-report" content="'


def render_page(page: Page) -> str:
    """Return the report page as HTML; the templates escape all values; the page forbids scripts and network access."""
    environment = Environment(
        loader=PackageLoader("wheelleg_exp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        # Make invisible control characters of a text visible, and replace characters that HTML cannot contain.
        finalize=lambda value: printable(value) if type(value) is str else value,
    )
    # Only the style sheet and ``MARK`` may enter the page without escaping.
    environment.filters["trusted"] = Markup
    style = environment.get_template("report.css").render()
    return environment.get_template("report.html").render(page=page, style=style, mark=MARK)


NAME = "report.html"
_HEAD = 4096  # The first 4096 bytes of a report contain ``MARK`` and the run.


def report_path(subject: Subject, output: Path | None) -> Path:
    """Return the path of the report; raise WheellegError if the path is not writable or is a file that is no report."""
    path = subject.path / NAME if output is None else output
    if path.is_dir():
        raise RunDirectoryError(f"'{path}' is a folder", expected="the name of a file, such as report.html")
    if (path.exists() or path.is_symlink()) and not (_is_report(path, subject.id) or _is_own(subject, path)):
        message = f"'{path}' exists and is not a report of this run, so it is not overwritten"
        raise RunDirectoryError(message, expected="-o with another name")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    # Creating a temporary file raises an error early if the user cannot write into the report's folder.
    with for_people(path), tempfile.TemporaryFile(dir=folder):
        return path


def write_report(subject: Subject, path: Path, html: str, command: Sequence[str]) -> None:
    """Write the report page to a file; if the file is in the run directory, add the file to the run's manifest."""
    write_text(path, html)
    inside = path.resolve().is_relative_to(subject.path.resolve())
    if subject.run is not None and inside and not _is_own(subject, path):
        subject.run.manifest().add(KIND, [path], command=command)


def _is_report(path: Path, run: str) -> bool:
    if path.is_symlink() or not path.is_file():
        return False
    with for_people(path, "read"), path.open("rb") as file:
        head = file.read(_HEAD).decode("utf-8", errors="replace")
    return f'{MARK}{escape(run)}">' in head


def _is_own(subject: Subject, path: Path) -> bool:
    """Return whether the run's manifest lists the file ``path`` as a report; the run may have been renamed."""
    folder = subject.path.resolve()
    if path.is_symlink() or not path.is_file() or not path.resolve().is_relative_to(folder):
        return False
    name = path.resolve().relative_to(folder).as_posix()
    entries = [entry.files[name] for entry in subject.additions(KIND) if name in entry.files]
    return bool(entries) and entries[-1]["sha256"] == sha256(path)


T = TypeVar("T")
Builder = Callable[[], Sequence[Block]]


def compile_page(subject: Subject, look: Look, verdict: Verdict) -> Page:
    """Return the report page of one run."""
    sentence = _or(lambda: headline.sentence(subject), "The outcome of this run is unknown: its manifest is damaged.")
    trained = _or(lambda: non_finite_note(subject.manifest.results), None)
    played = _or(lambda: non_finite_note(headline.played(subject)), None)
    not_finite = [f"{what}: {note}" for what, note in (("The training", trained), ("The last rollout", played)) if note]
    return Page(
        run=subject.id,
        task=subject.task,
        status=subject.status,
        tone=headline.TONES.get(subject.status, ""),
        # Write a non-breaking space between a number and its unit.
        sentence=re.sub(r"(?<=\d) (?=(?:s|mm|%)\b|%)", "\u00a0", sentence),
        cards=_or(lambda: headline.cards(subject, verdict.card), [verdict.card] if verdict.card else []),
        facts=_or(lambda: headline.facts(subject), []),
        command=shlex.join(subject.manifest.command),
        hero=_or(look.hero, None),
        sections=_sections(subject, look, verdict),
        # Build the sections before reading ``subject.problems``, because the sections add their errors to this list.
        notes=[Note(problem) for problem in dict.fromkeys([*not_finite, *subject.problems])],
        version=__version__,
    )


def _sections(subject: Subject, look: Look, verdict: Verdict) -> list[Section]:
    lead = "Figures of the policy without exploration noise, over the first episode of each environment."
    if subject.status == AGENT:
        lead = "Figures of these actions, over the first episode of each environment."
    elif not _or(lambda: bool(headline.played(subject)), False):
        lead = ""
    played = section("standing", "Does it stand?", lead, lambda: standing.performance_blocks(subject), look.of_play)
    if subject.status == AGENT:
        return [played, _settings(subject)]
    curves = (lambda: learning.first_curves(subject), look.of_training, lambda: learning.more_curves(subject))
    origin = [partial(part, subject) for part in (provenance.source, provenance.machine, provenance.robot)]
    files = (lambda: provenance.resumes(subject), lambda: provenance.files(subject))
    evaluation = section("evaluation", "How well did it do?", "", lambda: standing.evaluation_blocks(subject))
    return [
        played,
        *([evaluation] if evaluation.blocks else []),
        section("learning", "How it learned", "", *curves),
        section("objective", "What it optimises", "", lambda: learning.reward_blocks(subject)),
        section("trust", "Can it be trusted and repeated?", "", verdict.blocks),
        _settings(subject),
        section("source", "Source, machine and robot", "", *origin),
        section("files", "Files", "", *files),
    ]


def _settings(subject: Subject) -> Section:
    lead = "The values that differ from the task's defaults, and who set them."
    return section("settings", "What was set", lead, lambda: settings.settings_blocks(subject))


def section(name: str, title: str, lead: str, *builders: Builder) -> Section:
    """Return a section of the report page; an error while building the section becomes a sentence in the section."""
    blocks: list[Block] = []
    for builder in builders:
        try:
            blocks += builder()
        except WheellegError as error:
            blocks.append(Note(f"This part cannot be shown: {error}."))
        except Exception as error:  # Reading damaged files of a run can raise any error.
            blocks.append(Note(f"This part cannot be shown: {type(error).__name__}: {error}."))
    return Section(name, title, lead, blocks)


def _or(build: Callable[[], T], instead: T) -> T:
    """Return the result of ``build()``, or the value ``instead`` if ``build`` raises an error."""
    try:
        return build()
    except Exception:
        return instead
