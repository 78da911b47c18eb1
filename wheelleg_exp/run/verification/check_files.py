"""The manifest and the files that it lists."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.run.directory import checkpoint_iteration
from wheelleg_exp.run.files import sha256
from wheelleg_exp.run.inventory import FileFindings
from wheelleg_exp.run.seal import seal_holds
from wheelleg_exp.run.verification.findings import Check
from wheelleg_exp.run.verification.subject import Subject

# What a command takes for a part of the run when it lies there, whatever the manifest says.
_BELIEVED = re.compile(
    r"model_\d+\.pt|iterations\.jsonl|recording\.rrd|environment\.txt|(params|\.hydra|source|asset|exported)/.*"
)
# What is written while a run goes on, and recorded at its end.
_GROWING = re.compile(r"model_\d+\.pt|iterations\.jsonl|recording\.rrd|events\.out\.tfevents\..*|exported/.*")


def manifest(subject: Subject) -> Check:
    """Check that the manifest is what was written, and tell what it says of the run."""
    data = subject.data
    notes: list[str] = []
    holds = seal_holds(data)
    failures = [] if holds is not False else ["manifest.json was changed after it was written: its own digest differs"]
    if holds is None:
        notes.append("it has no digest of itself, so a change in it may go unseen")
    if data.get("id") not in (None, subject.run.id):
        notes.append(f"the run was called '{data['id']}' when it was made")
    if subject.status == "crashed":
        notes.append("its process is gone without an end: 'wheelleg resume' continues from the last checkpoint")
    error = data.get("error")
    if isinstance(error, Mapping):
        notes.append(f"it ended with {error.get('type')}: {error.get('message')}")
    resumes = [entry for entry in data["resumes"] if isinstance(entry, Mapping)]
    notes += map(_resume_note, sorted(resumes, key=lambda entry: entry.get("exact") is not False))
    return Check("manifest", f"format {data['format']}, {len(data['files'])} files recorded", failures, notes)


def _resume_note(entry: Mapping[str, Any]) -> str:
    where = "" if entry.get("iteration") is None else f" from iteration {entry['iteration']}"
    words = " ".join(map(str, entry.get("overrides") or ()))
    how = "" if "exact" not in entry else ", exactly" if entry["exact"] else ", not exactly"
    reasons = "; ".join(map(str, entry.get("why") or ()))
    return f"resumed on {entry.get('when')}{where}{how}" + "".join(f": {told}" for told in (words, reasons) if told)


def files(subject: Subject) -> Check:
    """Hold the files against their records: missing, changed, unreadable, not listed."""
    found = subject.manifest.compare_files()
    waiting = _waiting(subject)
    found.changed = [name for name in found.changed if name not in waiting]
    links = [name for name in found.missing if (subject.run.path / name).is_symlink()]
    failures = [f"{name} is a symbolic link, which may lead anywhere" for name in links]
    failures += [f"{name} is missing" for name in found.missing if name not in links]
    failures += [f"{name} was changed: {_how(subject, name)}" for name in found.changed]
    failures += [f"{name} cannot be read" for name in found.unreadable]
    wrong, notes = _unlisted(subject, found)
    notes += [f"{name} is not changed yet: a resume broke off before that" for name in waiting]
    records = subject.manifest.recorded_files()
    size = sum(int(record["size"]) for record in records.values()) / 1e6
    return Check("files", f"{len(records)} files, {size:.1f} MB", failures + wrong + _before(subject), notes)


def _waiting(subject: Subject) -> list[str]:
    """Return the files that the last resume recorded and has yet to write; the next one does."""
    entry = subject.data["resumes"][-1] if subject.data["resumes"] else None
    texts = entry.get("files_to_write") if isinstance(entry, Mapping) else None
    return sorted(texts) if isinstance(texts, Mapping) and not subject.has_ended else []


def _how(subject: Subject, name: str) -> str:
    recorded = int(subject.manifest.recorded_files()[name]["size"])
    size = (subject.run.path / name).stat().st_size
    return "same size, other content" if size == recorded else f"{size} bytes instead of {recorded}"


def _unlisted(subject: Subject, found: FileFindings) -> tuple[list[str], list[str]]:
    """Sort files that the manifest does not name into failures and notes."""
    unlisted = found.unlisted
    growing = [name for name in unlisted if not subject.has_ended and _GROWING.fullmatch(name)]
    if not subject.has_snapshot:
        growing = unlisted
    others = [name for name in unlisted if name not in growing]
    believed = [name for name in others if _BELIEVED.fullmatch(name)]
    notes = [f"{len(growing)} files are recorded when the run ends"] if growing else []
    notes += [f"{name} is not of the run: the manifest does not name it" for name in others if name not in believed]
    notes += [f"{name} is a symbolic link, and not of the run" for name in found.links]
    return [
        f"{name} is not in the manifest, yet commands would take it for part of the run" for name in believed
    ], notes


def _before(subject: Subject) -> list[str]:
    """Hold checkpoints that an earlier process recorded against its records, while there are no newer ones."""
    if subject.has_ended or not subject.data["resumes"]:
        return []
    entry = subject.data["resumes"][-1]
    before = entry.get("before") if isinstance(entry, Mapping) else None
    recorded = (before or {}).get("files") or {}
    kept = {name: r for name, r in recorded.items() if re.fullmatch(r"model_\d+\.pt", name)}
    start = entry.get("iteration")
    wrong = []
    for name, record in kept.items():
        path = subject.run.path / name
        old = path.is_file() and (start is None or checkpoint_iteration(path) < start)
        if old and sha256(path) != record["sha256"]:
            wrong.append(f"{name} was changed after it was recorded")
    return wrong
