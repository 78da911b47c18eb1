"""Check whether a run's manifest, or a file that the manifest lists, was changed later."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from wheelleg_exp.files import sha256
from wheelleg_exp.run.file_inventory import MANIFEST_NAME, FileFindings, FileRecord
from wheelleg_exp.run.iteration_log import IterationLog, read_log
from wheelleg_exp.run.manifest import FORMAT_WITH_VALUE_DIGEST, Manifest
from wheelleg_exp.run.records import RunRecord
from wheelleg_exp.run.run_config import written_config
from wheelleg_exp.run.run_directory import CHECKPOINT, NEEDED, RunDirectory, checkpoint_iteration
from wheelleg_exp.run.run_list import effective_status
from wheelleg_exp.run.source_snapshot import RECORD_NAME
from wheelleg_exp.run.stock_policies import is_stock

_UNENDED = ("running", "crashed")


@dataclass(frozen=True)
class Subject:
    """A run that is checked: the run's directory, manifest, status, and iteration log."""

    run: RunDirectory
    manifest: Manifest
    status: str
    log: IterationLog

    @property
    def facts(self) -> RunRecord:
        return self.manifest.facts

    @property
    def has_ended(self) -> bool:
        """True if the run's process has ended and was not killed."""
        return self.status not in _UNENDED

    @property
    def has_snapshot(self) -> bool:
        """True if the run has completely written its config, source code, and robot files."""
        return self.facts.has_source or self.has_ended

    @property
    def is_shipped(self) -> bool:
        """True for a policy that ships with ``wheelleg_exp``: it has no log and no source of its training."""
        return is_stock(self.run.path, self.facts.stock)


def read_subject(run: RunDirectory) -> Subject:
    """Read the manifest, the status, and the iteration log of a run."""
    manifest = run.manifest()
    return Subject(run, manifest, effective_status(manifest), read_log(run.iterations))


State = Literal["ok", "note", "failed", "not checked"]
_SHOWN = 10  # The largest number of lines that one check of a run prints.


@dataclass(frozen=True)
class Check:
    """The result of one check."""

    name: str
    text: str
    failures: list[str] = field(default_factory=list)  # Each of the ``failures`` is an error that makes the check fail.
    notes: list[str] = field(default_factory=list)  # Each of the ``notes`` is a harmless fact.
    skipped: str | None = None  # The reason why the check of a run was skipped; None if the check ran.

    @property
    def state(self) -> State:
        """The result of the check as one of the words ``failed``, ``not checked``, ``note``, and ``ok``."""
        if self.failures:
            return "failed"
        if self.skipped is not None:
            return "not checked"
        return "note" if self.notes else "ok"

    def lines(self) -> list[str]:
        head = f"{self.name:<12}{self.state:<12}{self.skipped or self.text}".rstrip()
        return [head, *(f"  {line}" for line in cut(self.failures)), *(f"  note: {line}" for line in cut(self.notes))]


@dataclass(frozen=True)
class RunFindings:
    """The result of ``verify_run``: the run directory, the run's status, and all checks."""

    path: Path
    status: str
    checks: list[Check]

    @property
    def is_sound(self) -> bool:
        return not any(check.failures for check in self.checks)

    @property
    def verdict(self) -> str:
        """``sound`` or ``damaged``."""
        return "sound" if self.is_sound else "damaged"

    def as_dict(self) -> dict[str, object]:
        checks = [{"state": check.state, **asdict(check)} for check in self.checks]
        return {"verdict": self.verdict, "run": str(self.path), "status": self.status, "checks": checks}

    def lines(self) -> list[str]:
        lines = [f"{self.path.parent.name}/{self.path.name}  {self.status}", ""]
        lines += [line for check in self.checks for line in check.lines()]
        failed = [check.name for check in self.checks if check.failures]
        reason = f"see {', '.join(failed)}" if failed else "the run is what its manifest says, and agrees with itself"
        return [*lines, "", f"{self.verdict}: {reason}"]


def cut(lines: Iterable[str]) -> list[str]:
    """Return at most 10 of the given lines, and a line with the number of omitted lines."""
    found = list(lines)
    hidden = len(found) - _SHOWN
    return [*found[:_SHOWN], f"and {hidden} more"] if hidden > 0 else found


# The names of files that commands treat as parts of a run, even if the run's manifest does not list them.
_READ_BY_COMMANDS = re.compile(
    r"model_\d+\.pt|iterations\.jsonl|recording\.rrd|failure\.npz|environment\.txt|(params|\.hydra|source|asset|exported)/.*"
)
# The names of files that a training writes while it runs, and records in the manifest when it ends.
_GROWING = re.compile(
    r"model_\d+\.pt|iterations\.jsonl|recording\.rrd|failure\.npz|events\.out\.tfevents\..*|(exported|videos)/.*"
)
_FORGED = "was changed after it was written: its own digest differs"


def manifest(subject: Subject) -> Check:
    """Check that nobody changed the manifest after the run wrote it; list the run's error and resumes as notes."""
    facts, written = subject.facts, subject.manifest.data["format"]
    notes: list[str] = []
    holds = subject.manifest.matches_digest()
    failures = [f"{MANIFEST_NAME} {_FORGED}"] if holds is False else []
    if holds is None:
        notes.append("it has no digest of itself, so a change in it cannot be detected")
    elif written == FORMAT_WITH_VALUE_DIGEST:
        notes.append("its digest is of rounded values: a change of the last digits cannot be detected")
    if facts.id not in (None, subject.run.id):
        notes.append(f"the run was called '{facts.id}' when it was made")
    if subject.status == "crashed":
        notes.append("its process died: 'wheelleg resume' continues from the last checkpoint")
    if facts.error is not None:
        notes.append(f"it ended with {facts.error.type}: {facts.error.message}")
    for entry in sorted(facts.resumes, key=lambda entry: entry.exact is not False):
        where = "" if entry.iteration is None else f" from iteration {entry.iteration}"
        how = "" if entry.exact is None else ", exactly" if entry.exact else ", not exactly"
        reasons = (" ".join(entry.overrides), "; ".join(entry.why))
        notes.append(": ".join(filter(None, (f"resumed on {entry.when}{where}{how}", *reasons))))
    return Check("manifest", f"format {written}, {len(facts.files)} files recorded", failures, notes)


def files(subject: Subject) -> Check:
    """Compare the files with the manifest's records: missing, changed, unreadable, and unlisted files."""
    found = subject.manifest.compare_files()
    others = [name for name in found.unlisted if not _is_growing(subject, name)]
    growing = len(found.unlisted) - len(others)
    notes = [f"{growing} files are recorded when the run ends"] if growing else []
    unknown = [name for name in others if not _READ_BY_COMMANDS.fullmatch(name)]
    notes += [f"{name} is not part of the run: the manifest does not list it" for name in unknown]
    notes += [f"{name} is a symbolic link and not part of the run" for name in found.links]
    notes += [f"{name} is not rewritten yet: a resume stopped before that" for name in _waiting(subject)]
    records = subject.manifest.recorded_files()
    size = sum(record["size"] for record in records.values()) / 1e6
    wrong = [f"{name} {what}" for name, what in _wrong(subject, found).items()]
    return Check("files", f"{len(records)} files, {size:.1f} MB", wrong, notes)


def damage(subject: Subject) -> dict[str, str]:
    """Return the problem of each damaged file by name, such as a changed manifest or a missing checkpoint."""
    wrong = {MANIFEST_NAME: _FORGED} if subject.manifest.matches_digest() is False else {}
    return wrong | _wrong(subject, subject.manifest.compare_files())


def _wrong(subject: Subject, found: FileFindings) -> dict[str, str]:
    waiting, root = _waiting(subject), subject.run.path
    wrong = {name: _what_became_of(root / name) for name in found.missing}
    for name in (name for name in found.changed if name not in waiting):
        recorded, size = subject.manifest.recorded_files()[name]["size"], (root / name).stat().st_size
        how = "same size, other content" if size == recorded else f"{size} bytes instead of {recorded}"
        wrong[name] = f"was changed: {how}"
    wrong |= {name: "cannot be read" for name in found.unreadable}
    wrong |= {name: "is missing, and the manifest does not list it" for name in _never_recorded(subject)}
    for name in found.unlisted:
        if _READ_BY_COMMANDS.fullmatch(name) and not _is_growing(subject, name):
            wrong[name] = "is not in the manifest, yet commands would read it as part of the run"
    return wrong | _changed_before(subject)


def _never_recorded(subject: Subject) -> list[str]:
    """Return the files that the manifest does not list although every run with the same settings writes them."""
    if not subject.has_snapshot or subject.is_shipped:
        return []
    expected = [*NEEDED, "environment.txt", f"source/{RECORD_NAME}"]
    if subject.status == "finished":
        expected += ["iterations.jsonl", *(f"exported/policy.{kind}" for kind in ("pt", "onnx", "json"))]
        options = written_config(subject.run).get("recording")
        expected += ["recording.rrd"] if isinstance(options, Mapping) and options.get("enabled") is True else []
    return [name for name in expected if name not in subject.manifest.recorded_files()]


def _what_became_of(path: Path) -> str:
    if path.is_symlink():
        return "is a symbolic link, which may lead anywhere"
    return "is missing" if not path.exists() else "is not a file"


def _is_growing(subject: Subject, name: str) -> bool:
    """Return whether a file is added to the manifest only at the end of the run."""
    return not subject.has_snapshot or (not subject.has_ended and _GROWING.fullmatch(name) is not None)


def _waiting(subject: Subject) -> list[str]:
    """Return the config files that a crashed resume did not rewrite; the next resume will rewrite them."""
    resumes = subject.facts.resumes
    return sorted(resumes[-1].files_to_write) if resumes and not subject.has_ended else []


def _changed_before(subject: Subject) -> dict[str, str]:
    """Return the problems of checkpoints whose sha256 differs from the sha256 that was recorded before a resume."""
    records: dict[str, FileRecord] = {}
    for entry in subject.facts.resumes:
        if entry.before is not None and entry.before.files:
            records |= {name: record for name, record in entry.before.files.items() if CHECKPOINT.fullmatch(name)}
            start = entry.iteration
            replaced = [name for name in records if start is not None and checkpoint_iteration(Path(name)) >= start]
            records = {name: record for name, record in records.items() if name not in replaced}
    wrong = {}
    for name, record in records.items():
        path = subject.run.path / name
        if not path.is_file():
            wrong[name] = _what_became_of(path)
        elif sha256(path) != record["sha256"]:
            wrong[name] = "was changed after it was recorded"
    return wrong
