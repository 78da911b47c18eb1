"""The page of a run: its sections one after the other; what fails in one is said there, and the rest stands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from wheelleg_exp import __version__
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.report import can_it_be_repeated as trust
from wheelleg_exp.report import does_it_stand as headline
from wheelleg_exp.report import how_it_learned as learning
from wheelleg_exp.report import how_it_stood as standing
from wheelleg_exp.report import how_well_it_did as evaluation
from wheelleg_exp.report import what_it_optimises as objective
from wheelleg_exp.report import what_it_ran_on as surroundings
from wheelleg_exp.report import what_was_set as settings
from wheelleg_exp.report.blocks import Block, Note, Page, Section
from wheelleg_exp.report.how_it_looked import Look
from wheelleg_exp.report.subject import AGENT, Subject
from wheelleg_exp.report.words import whole_units
from wheelleg_exp.run.listing import non_finite_note

T = TypeVar("T")
Builder = Callable[[], Sequence[Block]]


def compile_page(subject: Subject, look: Look, verdict: trust.Verdict) -> Page:
    """Return the page.

    Args:
        subject: the run.
        look: its recordings and the pictures made from them.
        verdict: what is known of its reproducibility.
    """
    of_training = subject.status != AGENT
    sections = [
        section(
            "standing",
            "Does it stand?",
            _or(lambda: _lead(subject), ""),
            lambda: standing.blocks(subject),
            look.of_play,
        ),
        *(_of_evaluation(subject) if of_training else []),
        *(_of_training(subject, look, verdict) if of_training else []),
        section("settings", "What was set", _SETTINGS, lambda: settings.blocks(subject)),
        *(_rest(subject) if of_training else []),
    ]
    return Page(
        run=subject.id,
        task=subject.task,
        status=subject.status,
        tone=headline.tone(subject),
        sentence=_or(
            lambda: whole_units(headline.sentence(subject)),
            "What became of this run cannot be told: its manifest is damaged.",
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
    """Return what there is to say of numbers that were not finite, in the training and in its last play."""
    trained = _or(lambda: non_finite_note(subject.manifest.get("results") or {}), None)
    played = _or(lambda: non_finite_note(headline.played(subject)), None)
    return [f"{what}: {note}" for what, note in (("The training", trained), ("The last rollout", played)) if note]


_SETTINGS = "What differs from the task as it is by itself, and who set it."


def _lead(subject: Subject) -> str:
    if subject.status == AGENT:
        return "What these actions did, over the first episode of each environment."
    if headline.played(subject):
        return "How the policy did without exploration noise, over the first episode of each environment."
    return ""


def _of_evaluation(subject: Subject) -> list[Section]:
    if not _or(lambda: evaluation.evaluated(subject), False):
        return []
    return [section("evaluation", "How well did it do?", "", lambda: evaluation.blocks(subject))]


def _of_training(subject: Subject, look: Look, verdict: trust.Verdict) -> list[Section]:
    return [
        section(
            "learning",
            "How it learned",
            "",
            lambda: learning.first(subject),
            look.of_training,
            lambda: learning.rest(subject),
        ),
        section("objective", "What it optimises", "", lambda: objective.blocks(subject)),
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
    """Return a section of the page; a part of it that fails is one sentence there."""
    return Section(name, title, lead, [block for builder in builders for block in _tried(builder)])


def _tried(builder: Builder) -> Sequence[Block]:
    """Return a part's blocks; one that fails, for whatever is in the files, is one sentence of the page."""
    try:
        return builder()
    except WheellegError as error:
        return [Note(f"This part cannot be shown: {error}.")]
    except Exception as error:  # the files may hold anything
        return [Note(f"This part cannot be shown: {type(error).__name__}: {error}.")]


def _or(build: Callable[[], T], instead: T) -> T:
    """Return what ``build`` returns, or ``instead`` where it fails for whatever is in the files."""
    try:
        return build()
    except Exception:
        return instead
