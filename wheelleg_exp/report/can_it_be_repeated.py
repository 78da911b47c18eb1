"""Can it be trusted and repeated: the run against its own manifest, replays and equal runs, what proves more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.report.blocks import Block, Card, Cell, Code, More, Note, Table, Text, Tone
from wheelleg_exp.report.subject import KIND, Subject
from wheelleg_exp.report.words import counted, size
from wheelleg_exp.run.directory import REPLAYS, RunDirectory
from wheelleg_exp.run.inventory import MANIFEST_NAME, odd_entries

if TYPE_CHECKING:
    from wheelleg_exp.verify import Check, Comparison, RunFindings

_COMPARED = 3  # of replays, and of equal runs; each opens checkpoints
_STATES: Mapping[str, Tone] = {"ok": "good", "note": "", "failed": "bad", "not checked": "warn"}
_VERDICTS: Mapping[str, Tone] = {"identical": "good", "within tolerance": "warn", "different": "bad"}
_PARAMS = ("params/env.yaml", "params/agent.yaml")


@dataclass(frozen=True)
class Repeat:
    """Another run that was to give the same numbers.

    Attributes:
        label: its task and id.
        how: ``replay`` or ``same settings``.
        verdict: what the comparison says, or why there is none.
        reason: one sentence.
        lines: the whole comparison.
    """

    label: str
    how: str
    verdict: str
    reason: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Verdict:
    """What is known of a run's reproducibility, as a key figure and as a part of the page."""

    card: Card | None
    findings: RunFindings | None
    repeats: Sequence[Repeat]
    subject: Subject
    problem: str = ""

    def blocks(self) -> list[Block]:
        """Return the part of the page."""
        return [*_found(self), *_repeated(self), *_proof(self)]


def judge(subject: Subject) -> Verdict:
    """Hold a run against its manifest, and against what repeats it."""
    if subject.run is None:
        return Verdict(None, None, [], subject)
    from wheelleg_exp.verify import verify_run

    odd = odd_entries(subject.path)
    if odd:  # behind a link is what is none of the run's, and of nobody's business who reads the report
        damaged = Card("Reproducibility", "Damaged", note="it holds links or pipes", tone="bad")
        name, what = next(iter(odd.items()))
        return Verdict(damaged, None, [], subject, f"{name} is {what}, which may lead anywhere")
    repeats = list(_repeats(subject, subject.run)) if subject.status != "running" else []
    try:
        findings = verify_run(subject.run)
    except Exception as error:  # the files may hold anything
        return Verdict(None, None, repeats, subject, str(error))
    failed = [check for check in findings.checks if _lines(subject, check.failures)]
    return Verdict(_card(subject, bool(failed), repeats), findings, repeats, subject)


def _card(subject: Subject, damaged: bool, repeats: Sequence[Repeat]) -> Card | None:
    label = "Reproducibility"
    if damaged:
        return Card(label, "Damaged", note="files are not what the manifest says", tone="bad")
    known = [repeat for repeat in repeats if repeat.verdict in _VERDICTS]
    worst = max(known, key=lambda repeat: list(_VERDICTS).index(repeat.verdict), default=None)
    if worst is None:
        note = "it still goes on" if subject.status == "running" else "files as recorded, not replayed yet"
        return Card(label, "Untested", note=note)
    count = f"{counted(len(known), 'repeated run')}"
    words = {
        "identical": ("Proven", f"{count}, equal to the bit"),
        "within tolerance": ("Close", f"{count}, equal within tolerance"),
        "different": ("Refuted", f"{worst.label} gave other numbers"),
    }[worst.verdict]
    return Card(label, words[0], note=words[1], tone=_VERDICTS[worst.verdict])


def _found(verdict: Verdict) -> list[Block]:
    subject, findings = verdict.subject, verdict.findings
    if findings is None:
        return [Note(f"The run could not be held against its manifest: {verdict.problem}.", "bad")]
    rows, wrong = [], []
    for check in findings.checks:
        failures, notes = _lines(subject, check.failures), _lines(subject, check.notes)
        state = "failed" if failures else "ok" if check.state == "failed" else check.state
        text = "; ".join([_text(subject, check), *notes])
        rows.append([Cell(check.name), Cell(state, tone=_STATES.get(state, "")), Cell(text)])
        wrong += failures
    said = (
        Note("The run is what its manifest says, and agrees with itself.", "good")
        if not wrong
        else Note(f"The run is not what its manifest says: {'; '.join(wrong[:10])}.", "bad")
    )
    return [said, Table("Held against its own manifest", ("Part", "State", "Looked at"), rows)]


def _text(subject: Subject, check: Check) -> str:
    """Return what was looked at; reports count for nothing, so that making one changes no report."""
    if check.name != "files" or subject.run is None or check.skipped:
        return check.skipped or check.text
    own = _reports(subject)
    kept = [record for name, record in subject.run.manifest().recorded_files().items() if name not in own]
    return f"{counted(len(kept), 'file')}, {size(sum(record['size'] for record in kept))}"


def _reports(subject: Subject) -> set[str]:
    return {name for entry in subject.additions(KIND) for name in entry.get("files", {})}


def _lines(subject: Subject, lines: Sequence[str]) -> list[str]:
    """Return the lines that are not about an earlier report."""
    own = tuple(f"{name} " for name in _reports(subject))
    return [line for line in lines if not (own and line.startswith(own))]


def _repeated(verdict: Verdict) -> list[Block]:
    if not verdict.repeats:
        return []
    rows = [
        [Cell(r.label, code=True), Cell(r.how), Cell(r.verdict, tone=_VERDICTS.get(r.verdict, "")), Cell(r.reason)]
        for r in verdict.repeats
    ]
    details: list[Block] = [Code("\n".join(r.lines), f"{r.how} {r.label}:") for r in verdict.repeats if r.lines]
    table = Table("Runs that were to give the same numbers", ("Run", "What it is", "Verdict", "Why"), rows)
    return [table, *([More("The comparisons", details)] if details else [])]


def _proof(verdict: Verdict) -> list[Block]:
    subject = verdict.subject
    of = subject.manifest.get("replay_of")
    found: list[Block] = [Text(f"This run is itself a replay of {of}.")] if of else []
    if subject.status == "running":
        return [*found, Note("Nothing can be said of a run that still goes on.", "")]
    lines = f"wheelleg verify {subject.id}\nwheelleg replay {subject.id}"
    return [*found, Code(lines, "Check the files again; train it again from its snapshot and compare to the bit:")]


# --- runs that repeat it ---


def _repeats(subject: Subject, run: RunDirectory) -> Iterator[Repeat]:
    known = str(subject.manifest.get("id") or run.id)
    others = [*_named(_replays(run, known), "replay"), *_named(_equals(run, subject), "same settings")]
    for how, folder in [*_named(_original(run, subject), "original"), *others]:
        yield _compared(run, folder, how)


def _original(run: RunDirectory, subject: Subject) -> list[Path]:
    """Return the folder of the run that this one replays, where it is still there."""
    of = subject.manifest.get("replay_of")
    if not isinstance(of, str) or Path(of).name != of:
        return []
    try:
        return [RunDirectory.open(of, run.root).path]
    except WheellegError:
        return []


def _named(folders: Sequence[Path], how: str) -> list[tuple[str, Path]]:
    return [(how, folder) for folder in folders[-_COMPARED:]]


def _replays(run: RunDirectory, known: str) -> list[Path]:
    """Return the folders of the run's replays, oldest first."""
    found = sorted((run.root / REPLAYS).glob(f"*/*/{MANIFEST_NAME}"))
    return [path.parent for path in found if path.parent != run.path and _data(path).get("replay_of") == known]


def _equals(run: RunDirectory, subject: Subject) -> list[Path]:
    """Return the folders of other runs of the task with the same parameters and seed, oldest first."""
    if subject.manifest.get("replay_of"):
        return []
    found = []
    for path in sorted(run.path.parent.glob(f"*/{MANIFEST_NAME}")):
        data = _data(path)
        same = _parameters(data) == _parameters(subject.manifest) and data.get("seeds") == subject.manifest.get("seeds")
        if path.parent != run.path and same and data.get("status") == "finished":
            found.append(path.parent)
    return found


def _parameters(manifest: Mapping[str, Any]) -> list[Any]:
    files = manifest.get("files") or {}
    return [(files.get(name) or {}).get("sha256", name) for name in _PARAMS]


def _data(path: Path) -> dict[str, Any]:
    try:
        return RunDirectory(path.parent).manifest().data
    except WheellegError:
        return {}


def _compared(run: RunDirectory, folder: Path, how: str) -> Repeat:
    from wheelleg_exp.verify import compare_runs

    label = f"{folder.parent.name}/{folder.name}"
    try:
        found = compare_runs(run, RunDirectory.open(folder, run.root), common=True)
    except Exception as error:  # the files may hold anything
        return Repeat(label, how, "not compared", str(error), [])
    verdict = "not compared" if found.parts["files"].state == "different" else found.verdict
    return Repeat(label, how, verdict, f"{_span(found)}: {found.reason}", found.lines())


def _span(found: Comparison) -> str:
    return counted(found.iterations, "iteration")
