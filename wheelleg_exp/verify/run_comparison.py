"""Compare two runs: equal bit for bit, within tolerance, or different, and their first difference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from wheelleg_exp.config.explaining.config_diff import Change
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.verify import comparison_text as text
from wheelleg_exp.verify import run_parts as part
from wheelleg_exp.verify.check_files import cut
from wheelleg_exp.verify.check_run import verify_run
from wheelleg_exp.verify.comparison_text import Divergence, first_divergence
from wheelleg_exp.verify.policy_differences import CheckpointComparison, compare_checkpoints, exported_part
from wheelleg_exp.verify.run_differences import (
    UNKNOWN_CODE,
    FactDifference,
    allowing,
    as_dict,
    brief,
    changes_text,
    decides,
    forbidding,
    recording_changes,
    robot_changes,
    run_differences,
    setting_changes,
)
from wheelleg_exp.verify.run_parts import Measured, Part, Parting, Span, measure, span_of
from wheelleg_exp.verify.tolerance import Tolerance, judge

_OF_THE_SNAPSHOT = ("params", "source", "asset")  # checks of the inputs, which decide every iteration
Verdict = Literal["identical", "within tolerance", "different"]


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare_runs``.

    Attributes:
        a: the first run.
        b: the second run.
        verdict: ``identical``, ``within tolerance`` or ``different``.
        reason: one sentence that explains the verdict.
        first_divergence: the first difference; None if there is none.
        iterations: how many iterations were compared.
        settings: differences of the settings.
        robot: differences of the robots.
        parts: the compared parts by name.
        checkpoints: the pairs of checkpoints.
        environment: differences of code, versions, hardware, threads, and environment variables.
        tolerance: the measured deviations if a difference is allowed; None if no difference is allowed or nothing
            differs.
    """

    a: Measured
    b: Measured
    verdict: Verdict
    reason: str
    first_divergence: Divergence | None
    iterations: int
    settings: list[Change]
    robot: list[Change]
    parts: dict[str, Part]
    checkpoints: CheckpointComparison
    environment: list[FactDifference]
    tolerance: Tolerance | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        first = None if self.first_divergence is None else asdict(self.first_divergence)
        sections = dict.fromkeys(d.section for d in self.environment)
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "first_divergence": first,
            "tolerance": None if self.tolerance is None else self.tolerance.as_dict(),
            "a": self.a.as_dict(),
            "b": self.b.as_dict(),
            "iterations": self.iterations,
            "parts": {name: found.as_dict() for name, found in self.parts.items()},
            "environment": {
                section: [_fact(d) for d in self.environment if d.section == section] for section in sections
            },
        }

    def lines(self) -> list[str]:
        """Return the printed lines, the verdict last."""
        lines = [text.run_line("A", self.a), text.run_line("B", self.b), ""]
        lines += [f"{name:<12}{found.state:<14}{found.text}" for name, found in self.parts.items()]
        for side, measured in (("A", self.a), ("B", self.b)):
            lines += cut([f"{side}: {name} {what}" for name, what in measured.damage.items()])
        if self.first_divergence is not None:
            lines += ["", *text.divergence_lines(self.first_divergence)]
        if self.tolerance is not None:
            lines += ["", "tolerance", *(f"  {line}" for line in self.tolerance.lines())]
        lines += text.environment_lines(self.environment, self.settings, equal=self.verdict == "identical")
        return [*lines, "", f"{self.verdict}: {self.reason}"]


def compare_runs(
    a: RunDirectory, b: RunDirectory, *, iterations: int | None = None, common: bool = False
) -> Comparison:
    """Compare two runs bit for bit.

    A run that is still running is compared up to its last iteration. Otherwise, runs of different length are different.

    Args:
        a: a run.
        b: another run.
        iterations: compare only the iterations below this number.
        common: compare only the iterations that both have.

    Raises:
        RunDirectoryError: both are the same directory, a manifest cannot be read, or the runs have no common iteration.
    """
    if a.path == b.path:
        raise RunDirectoryError(f"both are the run '{a.id}'", expected="two runs, or one run to check by itself")
    one, other = measure(a), measure(b)
    return _compare(one, other, span_of(one, other, iterations, common))


def _compare(a: Measured, b: Measured, span: Span) -> Comparison:
    ones, others = a.log.lines[: span.until], b.log.lines[: span.until]
    settings, asked = _settings(a.run, b.run)
    robot = robot_changes(a.run, b.run)
    environment = run_differences(a.run, b.run)
    checkpoints = compare_checkpoints(a.run, b.run, span.until)
    parts = {
        "files": _files_part(a, b, span),
        "settings": asked,
        "robot": _changes_part(_decisive(robot, environment), "sources, MJCF and compiled model"),
        "scalars": part.scalars_part(ones, others),
        "digests": part.digests_part(ones, others),
        "checkpoints": _checkpoints_part(checkpoints),
        **_whole_parts(a.run, b.run, span, settings),
    }
    parted = part.parting(ones, others)
    allowed = allowing(environment) and not forbidding(environment)
    tolerance = _tolerance(ones, others, parted, checkpoints, span) if allowed else None
    verdict, reason = _verdict(parts, span, (a, b), environment, tolerance)
    # Only an identical verdict needs the expensive check against a manifest that was rewritten to hide a change.
    if verdict == "identical" and any((wrong := _contradictions(a, b, span)).values()):
        parts["files"] = _damage_part(wrong)
        verdict, reason = "different", f"damaged: {parts['files'].text}; {reason}"
    return Comparison(
        a=a,
        b=b,
        verdict=verdict,
        reason=reason,
        first_divergence=first_divergence(parts, parted, checkpoints, span, (a, b)),
        iterations=span.until,
        settings=settings,
        robot=robot,
        parts=parts,
        checkpoints=checkpoints,
        environment=environment,
        tolerance=tolerance,
    )


def _files_part(a: Measured, b: Measured, span: Span) -> Part:
    """Return the missing and damaged files that belong to the compared iterations."""
    wrong = {
        side: [f"{name} {what}" for name, what in run.damage.items() if span.covers(name)]
        for side, run in (("A", a), ("B", b))
    }
    return _damage_part(wrong) if any(wrong.values()) else Part("equal", "all as their manifests recorded them")


def _damage_part(wrong: dict[str, list[str]]) -> Part:
    text = "; ".join(f"{side}: {part.some(files, 1)}" for side, files in wrong.items() if files)
    return Part("different", text, {"damaged": wrong})


def _contradictions(a: Measured, b: Measured, span: Span) -> dict[str, list[str]]:
    """Return by side the files that contradict the run's other files. They reveal a manifest that was rewritten."""
    return {
        side: [
            failure
            for check in verify_run(measured.run).checks
            if span.whole or check.name in _OF_THE_SNAPSHOT
            for failure in check.failures
        ]
        for side, measured in (("A", a), ("B", b))
    }


def _settings(a: RunDirectory, b: RunDirectory) -> tuple[list[Change], Part]:
    try:
        changes = setting_changes(a, b)
    except RunDirectoryError as error:
        return [], Part("not compared", str(error))
    return changes, _changes_part([c for c in changes if decides(c.keys)], "seed, task, env and agent")


def _decisive(robot: list[Change], environment: list[FactDifference]) -> list[Change]:
    """Return the robot's changes, except for a compiled model that only another MuJoCo version wrote differently."""
    another = any((d.section, d.name) == ("versions", "mujoco") for d in environment)
    return [change for change in robot if not (another and change.key == "compiled model")]


def _changes_part(changes: list[Change], what: str) -> Part:
    details = {"differing": [as_dict(change) for change in changes]}
    if not changes:
        return Part("equal", what, details)
    return Part("different", changes_text(changes), details)


def _checkpoints_part(found: CheckpointComparison) -> Part:
    details = {
        "pairs": [pair.as_dict() for pair in found.pairs],
        "only_a": found.only_a,
        "only_b": found.only_b,
    }
    if not found.pairs:
        return Part("not compared", "the runs have no checkpoints of the same iteration", details)
    state: part.State = "equal" if all(pair.equal for pair in found.pairs) else "different"
    return Part(state, text.checkpoints_text(found), details)


def _whole_parts(a: RunDirectory, b: RunDirectory, span: Span, settings: list[Change]) -> dict[str, Part]:
    """Compare results of whole runs. If one run went on longer, they say nothing about the common iterations."""
    if not span.closed:
        why = "a run did not end by itself" if span.whole else "the runs have different lengths"
        other = Part("not compared", why)
        return {"recording": other, "exported": other, "results": other}
    options = recording_changes(settings)
    recording = part.recording_part(a, b)
    if recording.state == "different" and options and "unreadable" not in recording.details:
        recording = Part("not compared", f"recorded with other options: {changes_text(options)}")
    return {"recording": recording, "exported": exported_part(a, b), "results": part.results_part(a, b)}


def _tolerance(
    a: Sequence[part.Line], b: Sequence[part.Line], parted: Parting | None, found: CheckpointComparison, span: Span
) -> Tolerance | None:
    if parted is None:
        return None
    here = next((pair for pair in found.pairs if pair.iteration == parted.iteration), None)
    distance = None if here is None or here.parameters is None else (here.iteration, here.parameters)
    return judge(a, b, distance, whole=span.whole)


def _verdict(
    parts: dict[str, Part],
    span: Span,
    sides: tuple[Measured, Measured],
    environment: list[FactDifference],
    tolerance: Tolerance | None,
) -> tuple[Verdict, str]:
    differing = [name for name, found in parts.items() if found.state == "different" and name != "files"]
    asked = [name for name in ("settings", "robot") if name in differing]
    numbers = [name for name in differing if name not in asked]
    common = f"the {span.until} common iterations " + ("differ" if numbers else "are equal to the bit")
    if parts["files"].state == "different":
        return "different", f"damaged: {parts['files'].text}" + (f"; {common}" if span.until else "")
    if asked:
        return "different", f"{_differ(asked)}" + ("" if numbers else "; the numbers are equal nonetheless")
    if span.shorter:
        status = sides["AB".index(span.shorter)].status
        return "different", f"{span.shorter} stops after iteration {span.until - 1} ({status}); {common}"
    if numbers:
        return _verdict_on_numbers(numbers, parts, environment, tolerance)
    if parts["settings"].state == "not compared":
        return "different", f"not shown to be equal: {parts['settings'].text}"
    if all(parts[name].state == "not compared" for name in ("digests", "checkpoints")):
        return "different", "not shown to be equal: there are neither digests nor checkpoints to compare"
    partly = "" if span.closed else ", as far as they were compared"
    forbidden = forbidding(environment)
    code = f", although {_code_text(forbidden)}" if forbidden else ""
    return "identical", f"equal to the bit in {span.until} iterations{partly}{code}"


def _verdict_on_numbers(
    numbers: list[str], parts: dict[str, Part], environment: list[FactDifference], tolerance: Tolerance | None
) -> tuple[Verdict, str]:
    reasons = "; ".join(dict.fromkeys(str(difference.allows) for difference in allowing(environment)))
    unreadable = "unreadable" in parts["recording"].details or _damaged(parts)
    if unreadable or tolerance is None:
        return "different", _differ(numbers) + _not_allowed(forbidding(environment), reasons)
    if tolerance.unknown:
        return "different", f"not shown to be within tolerance: {tolerance.note}"
    if not tolerance.within:
        return "different", f"further apart than rounding allows, even with {reasons}"
    return "within tolerance", f"{tolerance.summary()}, which is allowed: {reasons}"


def _not_allowed(forbidden: list[FactDifference], reasons: str) -> str:
    if forbidden:
        return f"; {_code_text(forbidden)}" + (f", which {reasons} cannot excuse" if reasons else "")
    return "" if reasons else ", and nothing in the environment allows it"


def _code_text(forbidden: Sequence[FactDifference]) -> str:
    """Return what rules out a tolerance: other source code, or an inexact resume."""
    code = [d.name for d in forbidden if d.section == "code"]
    if code:
        if all(name.startswith(UNKNOWN_CODE) for name in code):
            return "the code was not recorded"
        return f"the code differs ({'; '.join(dict.fromkeys(d.note for d in forbidden if d.note))})"
    first = forbidden[0]
    return f"{'B' if first.a is None else 'A'} was resumed {first.name} ({brief(first.b or first.a)})"


def _differ(names: Sequence[str]) -> str:
    plural = len(names) > 1 or names[0].endswith("s")
    return f"{' and '.join(names)} {'differ' if plural else 'differs'}"


def _damaged(parts: dict[str, Part]) -> bool:
    return any(pair["state"] == "unreadable" for pair in parts["checkpoints"].details["pairs"])


def _fact(difference: FactDifference) -> dict[str, Any]:
    facts = {"name": difference.name, "a": difference.a, "b": difference.b, "allows": difference.allows}
    return {**facts, "note": difference.note} if difference.note else facts
