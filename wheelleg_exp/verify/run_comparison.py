"""Compare two runs: equal bit for bit, within tolerance, or different, and their first difference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

from wheelleg_exp.config.explaining.config_diff import Change
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_changes import first_few
from wheelleg_exp.verify import run_differences as differences
from wheelleg_exp.verify import run_parts as part
from wheelleg_exp.verify.check_files import cut
from wheelleg_exp.verify.check_run import verify_run
from wheelleg_exp.verify.comparison_text import Divergence, environment_lines, first_divergence
from wheelleg_exp.verify.policy_differences import CheckpointComparison, compare_checkpoints, exported_part
from wheelleg_exp.verify.run_differences import FactDifference, brief, changes_text, plain_changes
from wheelleg_exp.verify.run_parts import Measured, Part, Sides, Span, measure, span_of
from wheelleg_exp.verify.tolerance import Tolerance, judge

_OF_THE_SNAPSHOT = ("params", "source", "asset")  # ``verify_run`` has three checks of a run's input files.
Verdict = Literal["identical", "within tolerance", "different"]


@dataclass(frozen=True)
class Comparison:
    """The result of ``compare_runs``."""

    a: Measured
    b: Measured
    verdict: Verdict
    reason: str  # ``reason`` explains the verdict, such as ``settings differ``.
    first_divergence: Divergence | None
    iterations: int  # The number of compared training iterations.
    settings: list[Change]
    robot: list[Change]
    parts: dict[str, Part]
    checkpoints: CheckpointComparison
    environment: list[FactDifference]  # ``environment`` lists differences such as other code or another CPU.
    tolerance: Tolerance | None = None  # None unless a cause such as another CPU can explain unequal numbers.

    def as_dict(self) -> dict[str, object]:
        environment: dict[str, list[dict[str, object]]] = {}
        for d in self.environment:
            note = {"note": d.note} if d.note else {}
            facts = {"name": d.name, "a": d.a, "b": d.b, "allows": d.allows, **note}
            environment.setdefault(d.section, []).append(facts)
        return {
            "verdict": self.verdict,
            "reason": self.reason,
            "first_divergence": None if self.first_divergence is None else self.first_divergence.as_dict(),
            "tolerance": None if self.tolerance is None else self.tolerance.as_dict(),
            "a": self.a.as_dict(),
            "b": self.b.as_dict(),
            "iterations": self.iterations,
            "parts": {name: found.as_dict() for name, found in self.parts.items()},
            "environment": environment,
        }

    def lines(self) -> list[str]:
        sides = (("A", self.a), ("B", self.b))
        lines = [f"{name}  {run.label}  {run.status}, {len(run.log.lines)} iterations" for name, run in sides]
        lines += ["", *(f"{name:<12}{found.state:<14}{found.text}" for name, found in self.parts.items())]
        for side, measured in sides:
            lines += cut([f"{side}: {name} {what}" for name, what in measured.damage.items()])
        if self.first_divergence is not None:
            lines += ["", *self.first_divergence.lines()]
        if self.tolerance is not None:
            lines += ["", "tolerance", *(f"  {line}" for line in self.tolerance.lines())]
        lines += environment_lines(self.environment, self.settings, equal=self.verdict == "identical")
        return [*lines, "", f"{self.verdict}: {self.reason}"]


def compare_runs(
    a: RunDirectory, b: RunDirectory, *, iterations: int | None = None, common: bool = False
) -> Comparison:
    """Compare two training runs bit for bit.

    ``iterations`` restricts the comparison to the first ones, and ``common`` to those that both runs have. A running
    training is compared up to its last finished iteration. Otherwise, runs of unequal length count as different.
    """
    if a.path == b.path:
        raise RunDirectoryError(f"the two runs are the same run '{a.id}'", expected="two runs, or one run alone")
    one, other = measure(a), measure(b)
    return _compare(one, other, span_of(one, other, iterations, common))


def _compare(a: Measured, b: Measured, span: Span) -> Comparison:
    ones, others = a.log.lines[: span.until], b.log.lines[: span.until]
    settings: list[Change] = []
    decisive: list[Change] = []
    try:
        changes = plain_changes(differences.settings_of(a.run), differences.settings_of(b.run))
        settings = sorted(changes, key=lambda change: not differences.decides(change.keys))
        decisive = [change for change in settings if differences.decides(change.keys)]
        asked = _changes_part(decisive, "seed, task, env and agent")
    except RunDirectoryError as error:
        asked = Part("not compared", str(error))
    robot = plain_changes(differences.robot_of(a.run), differences.robot_of(b.run))
    environment = differences.run_differences(a.run, b.run)
    # Two versions of MuJoCo write different bytes for the same compiled model.
    another = any(d.section == "versions" and d.name == differences.MUJOCO for d in environment)
    other_robot = [change for change in robot if not (another and change.key == "compiled model")]
    checkpoints, logs = compare_checkpoints(a.run, b.run, span.until), part.compare_logs(ones, others)
    damage = {
        side: [f"{name} {what}" for name, what in run.damage.items() if span.covers(name)]
        for side, run in (("A", a), ("B", b))
    }
    parts = {
        "files": _damage_part(damage),
        "settings": asked,
        "robot": _changes_part(other_robot, "sources, MJCF and compiled model"),
        "scalars": part.scalars_part(logs, max((len(line.scalars) for line in ones), default=0)),
        "digests": part.digests_part(logs),
        "checkpoints": _checkpoints_part(checkpoints),
        **_whole_parts(a, b, span, settings),
    }
    parted = next((parting for parting in logs if parting.digests or parting.scalars), None)
    allowed = differences.allowing(environment) and not differences.forbidding(environment)
    tolerance = None
    if allowed and parted is not None:
        here = next((pair for pair in checkpoints.pairs if pair.iteration == parted.iteration), None)
        distance = None if here is None or here.parameters is None else (here.iteration, here.parameters)
        tolerance = judge(ones, others, distance, whole=span.whole)
    damaged = [pair for pair in checkpoints.pairs if pair.state == "unreadable"]
    excuse = None if damaged or "unreadable" in parts["recording"].details else tolerance
    verdict, reason = _verdict(parts, span, (a, b), environment, excuse)
    if verdict == "identical":
        # Search the files of both runs for contradictions only if the runs seem identical, because this is slow.
        for side, run in (("A", a), ("B", b)):
            checks = [c for c in verify_run(run.run).checks if span.whole or c.name in _OF_THE_SNAPSHOT]
            damage[side] = [failure for check in checks for failure in check.failures]
        if any(damage.values()):
            parts["files"] = _damage_part(damage)
            verdict, reason = "different", f"damaged: {parts['files'].text}; {reason}"
    first = first_divergence({"settings": decisive, "robot": other_robot}, parts, parted, checkpoints, span, (a, b))
    return Comparison(
        a, b, verdict, reason, first, span.until, settings, robot, parts, checkpoints, environment, tolerance
    )


def _damage_part(wrong: Mapping[str, list[str]]) -> Part:
    text = "; ".join(f"{side}: {first_few(files, 1)}" for side, files in wrong.items() if files)
    if not text:
        return Part("equal", "all as their manifests recorded them")
    return Part("different", text, {"damaged": wrong})


def _changes_part(changes: list[Change], what: str) -> Part:
    details = {"differing": [differences.as_dict(change) for change in changes]}
    return Part("equal", what, details) if not changes else Part("different", changes_text(changes), details)


def _checkpoints_part(found: CheckpointComparison) -> Part:
    if not found.pairs:
        return Part("not compared", "the runs have no checkpoints of the same iteration", asdict(found))
    states = [pair.state for pair in found.pairs]
    kinds = {"bytes": "byte for byte", "content": "equal, in different bytes"}
    kinds |= {"different": "different", "unreadable": "unreadable"}
    texts = [f"{states.count(state)} {words}" for state, words in kinds.items() if state in states]
    texts += [f"{len(only)} only in {side}" for side, only in (("A", found.only_a), ("B", found.only_b)) if only]
    first = next((pair for pair in found.pairs if not pair.equal), None)
    if first is not None:
        texts.append(first.problem or f"the first model_{first.iteration}.pt")
    return Part("equal" if first is None else "different", ", ".join(texts), asdict(found))


def _whole_parts(a: Measured, b: Measured, span: Span, settings: list[Change]) -> dict[str, Part]:
    """Compare recordings, exported policies, and results, unless a run was killed or the runs have unequal lengths."""
    if not span.closed:
        why = "a run did not end by itself" if span.whole else "the runs have different lengths"
        other = Part("not compared", why)
        return {"recording": other, "exported": other, "results": other}
    options = [change for change in settings if change.keys[0].startswith("recording")]
    recording = part.recording_part(a, b)
    if recording.state == "different" and options and "unreadable" not in recording.details:
        recording = Part("not compared", f"recorded with other options: {changes_text(options)}")
    return {"recording": recording, "exported": exported_part(a.run, b.run), "results": part.results_part(a.run, b.run)}


def _verdict(
    parts: dict[str, Part], span: Span, sides: Sides, environment: list[FactDifference], tolerance: Tolerance | None
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
        return _verdict_on_numbers(numbers, environment, tolerance)
    if parts["settings"].state == "not compared":
        return "different", f"not shown to be equal: {parts['settings'].text}"
    if all(parts[name].state == "not compared" for name in ("digests", "checkpoints")):
        return "different", "not shown to be equal: there are neither digests nor checkpoints to compare"
    partly = "" if span.closed else ", as far as they were compared"
    forbidden = differences.forbidding(environment)
    code = f", although {_code_text(forbidden)}" if forbidden else ""
    return "identical", f"equal to the bit in {span.until} iterations{partly}{code}"


def _verdict_on_numbers(
    numbers: list[str], environment: list[FactDifference], tolerance: Tolerance | None
) -> tuple[Verdict, str]:
    reasons = "; ".join(dict.fromkeys(str(difference.allows) for difference in differences.allowing(environment)))
    if tolerance is None:
        why = "" if reasons else ", and nothing in the environment allows it"
        if forbidden := differences.forbidding(environment):
            why = f"; {_code_text(forbidden)}" + (f", which {reasons} cannot excuse" if reasons else "")
        return "different", _differ(numbers) + why
    if tolerance.unknown:
        return "different", f"not shown to be within tolerance: {tolerance.note}"
    if not tolerance.within:
        return "different", f"further apart than rounding allows, even with {reasons}"
    return "within tolerance", f"{tolerance.summary()}, which is allowed: {reasons}"


def _code_text(forbidden: Sequence[FactDifference]) -> str:
    """Return why two runs must not be compared within tolerance, such as different source code or an inexact resume."""
    code = [d.name for d in forbidden if d.section == "code"]
    if code:
        if all(name.startswith(differences.UNKNOWN_CODE) for name in code):
            return "the code was not recorded"
        return f"the code differs ({'; '.join(dict.fromkeys(d.note for d in forbidden if d.note))})"
    first = forbidden[0]
    return f"{'B' if first.a is None else 'A'} was resumed {first.name} ({brief(first.b or first.a)})"


def _differ(names: Sequence[str]) -> str:
    plural = len(names) > 1 or names[0].endswith("s")
    return f"{' and '.join(names)} {'differ' if plural else 'differs'}"
