"""Compare the logged scalars and hashes, the recordings, and the results of two runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import Line, comparable_digests
from wheelleg_exp.run.manifest import SNAPSHOT
from wheelleg_exp.run.run_directory import CHECKPOINT, RunDirectory
from wheelleg_exp.run.source_changes import first_few
from wheelleg_exp.verify.check_files import Subject, damage, read_subject
from wheelleg_exp.verify.run_differences import as_dict, plain_changes

_CLOSED = ("finished", "interrupted")
_OF_ITERATIONS = (MANIFEST_NAME, "iterations.jsonl")


@dataclass(frozen=True)
class Measured(Subject):
    """One of two compared runs, with the problem of each damaged file by name."""

    damage: dict[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        return f"{self.run.path.parent.name}/{self.run.id}"

    def as_dict(self) -> dict[str, object]:
        facts = {"run": str(self.run.path), "status": self.status, "iterations": len(self.log.lines)}
        return {**facts, "problems": [f"{name} {what}" for name, what in self.damage.items()]}


@dataclass(frozen=True)
class Span:
    """The iterations of two runs that are compared: the iterations below ``until``."""

    until: int
    whole: bool  # True if the comparison covers all iterations of both runs.
    closed: bool  # True if all iterations of both runs are compared, and each run finished or was interrupted.
    shorter: str | None = None  # ``A`` or ``B`` names a run that is too short for a full comparison; otherwise None.

    def covers(self, name: str) -> bool:
        """Return whether damage to a file of a run affects the compared iterations."""
        checkpoint = CHECKPOINT.fullmatch(name)
        if self.whole or checkpoint is None:
            return self.whole or name in _OF_ITERATIONS or name.startswith(SNAPSHOT)
        return int(checkpoint[1]) < self.until


def measure(run: RunDirectory) -> Measured:
    """Read a run's status and iteration log, and find the run's damaged files."""
    subject = read_subject(run)
    found = damage(subject)
    if run.iterations.exists() and subject.log.problems:
        found.setdefault(run.iterations.name, f"is damaged: {'; '.join(subject.log.problems)}")
    return Measured(run, subject.manifest, subject.status, subject.log, found)


def span_of(a: Measured, b: Measured, iterations: int | None, common: bool) -> Span:
    """Decide which iterations of two runs to compare; raise RunDirectoryError if a run has no finished iteration."""
    lengths = len(a.log.lines), len(b.log.lines)
    asked = max(lengths) if iterations is None else iterations
    until = min(*lengths, asked)
    if until < 1 and not (a.damage or b.damage):
        empty = a if not lengths[0] else b
        problem = f": {empty.log.problems[0]}" if empty.log.problems else ""
        message = f"no iteration of '{empty.run.id}' can be compared{problem}"
        raise RunDirectoryError(message, expected="runs with finished iterations")
    running = any(side.status == "running" for side in (a, b))
    uneven = min(lengths[0], asked) != min(lengths[1], asked)
    whole = lengths[0] == lengths[1] == until and not running
    closed = whole and all(side.status in _CLOSED for side in (a, b))
    counts = uneven and not common and not running
    return Span(until, whole, closed, ("A" if lengths[0] < lengths[1] else "B") if counts else None)


State = Literal["equal", "different", "not compared"]
Sides = tuple[Measured, Measured]  # The two compared runs A and B.

_TIME = "seconds"  # Results whose name ends with ``seconds`` are durations, which differ even between equal runs.


@dataclass(frozen=True)
class Part:
    """One part of a comparison: its state, one printed line, and data for programs."""

    state: State
    text: str
    details: Mapping[str, object] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        return {"state": self.state, "text": self.text, **self.details}


@dataclass(frozen=True)
class Parting:
    """One iteration of two logs: the names of the compared and the differing hashes, and of the differing scalars."""

    iteration: int
    names: list[str]
    digests: list[str]
    scalars: list[str]


def compare_logs(a: Sequence[Line], b: Sequence[Line]) -> list[Parting]:
    """Compare each iteration of two logs of equal length; the scalar 0.0 differs from -0.0."""
    found = []
    for one, other in zip(a, b, strict=True):
        names = [name for name in comparable_digests(one, other.digest_format) if name in other.digests]
        digests = [name for name in names if one.digests[name] != other.digests[name]]
        x, y = one.scalars, other.scalars
        scalars = [n for n in dict.fromkeys([*x, *y]) if n not in x or n not in y or repr(x[n]) != repr(y[n])]
        found.append(Parting(one.iteration, names, digests, scalars))
    return found


def scalars_part(logs: Sequence[Parting], width: int) -> Part:
    """Return how the logged scalars of two runs differ; ``width`` is the number of scalars of an iteration."""
    changed = [parting for parting in logs if parting.scalars]
    if not logs:
        return Part("not compared", "the runs have no common iteration")
    details = {"iterations": len(logs), "differing_iterations": len(changed)}
    if not changed:
        return Part("equal", f"{width} scalars of {len(logs)} iterations", details)
    first = changed[0]
    text = f"from iteration {first.iteration} on, in {len(changed)} of {len(logs)} iterations"
    return Part("different", text, {**details, "first": first.iteration, "names": first.scalars})


def digests_part(logs: Sequence[Parting]) -> Part:
    """Return how the logged hashes of two runs' training states differ."""
    names = Counter(name for parting in logs for name in parting.names)
    first: dict[str, int] = {}
    for parting in logs:
        first |= {name: parting.iteration for name in parting.digests if name not in first}
    details = {"names": list(names), "first_difference": first}
    if not names:
        return Part("not compared", "the runs have no digests in the same format", details)
    if not first:
        return Part("equal", f"{', '.join(names)}: {max(names.values())} iterations", details)
    text = ", ".join(f"{name} from iteration {k} on" for name, k in sorted(first.items(), key=lambda item: item[1]))
    return Part("different", text, details)


def recording_part(a: Measured, b: Measured) -> Part:
    """Compare the recordings of two trainings, except texts and wall-clock times."""
    ones, others = a.run.recording, b.run.recording
    if not ones.exists() or not others.exists():
        owners = [side for side, path in (("A", ones), ("B", others)) if path.exists()]
        return Part("not compared", f"only {owners[0]} has a recording" if owners else "neither run has a recording")
    from wheelleg_exp.recording.reading.recording_digest import entity_digests

    sides: list[dict[str, str]] = []
    for side, run, path in (("A", a, ones), ("B", b, others)):
        if what := run.damage.get(path.name):  # Decoding a changed recording can crash the process.
            return Part("different", f"{side}'s recording {what}", {"unreadable": side})
        try:
            sides.append(entity_digests(path))
        except RunDirectoryError as error:
            return Part("different", f"{side}'s cannot be read: {error}", {"unreadable": side})
    one, other = sides
    changed = [entity for entity in one if entity in other and one[entity] != other[entity]]
    only_a, only_b = ([entity for entity in x if entity not in y] for x, y in ((one, other), (other, one)))
    details = {"entities": len(one), "differing": changed, "only_a": only_a, "only_b": only_b}
    counted = [(changed, f"of {len(one)} entities differ"), (only_a, "only in A"), (only_b, "only in B")]
    text = "; ".join(f"{len(names)} {what} ({first_few(names)})" for names, what in counted if names)
    return Part("different", text, details) if text else Part("equal", f"{len(one)} entities", details)


def results_part(a: RunDirectory, b: RunDirectory) -> Part:
    """Compare the results in the manifests of two runs, except results that are durations."""
    ones, others = ({k: v for k, v in run.manifest().results.items() if not k.endswith(_TIME)} for run in (a, b))
    if not ones or not others:
        owners = [side for side, results in (("A", ones), ("B", others)) if results]
        return Part("not compared", f"only {owners[0]} has results" if owners else "neither run has results")
    changes = plain_changes(ones, others)
    details = {"differing": [as_dict(change) for change in changes]}
    if not changes:
        return Part("equal", f"{len(ones)} figures", details)
    sides = [[f"{x:.6g}" if isinstance(x, float) else str(x) for x in (change.a, change.b)] for change in changes]
    texts = [f"{change.key} {a} and {b}" for change, (a, b) in zip(changes, sides, strict=True)]
    return Part("different", first_few(texts), details)
