"""What came out of the run: iterations, checkpoints, recording, exported policy."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, require_mapping, sha256
from wheelleg_exp.reading import json_value, require_bounded
from wheelleg_exp.run.directory import FAILURE, checkpoint_iteration
from wheelleg_exp.verify.checked_run import Check, Subject


def iterations(subject: Subject) -> Check:
    """Check that the log counts from 0 without gap or repeat, and ends as the results say."""
    log, failures = subject.log, list(subject.log.problems)
    notes: list[str] = []
    missing = not subject.run.iterations.is_file()
    if missing and not subject.run.checkpoints() and subject.status != "finished":
        return Check("iterations", "", skipped="the run has no iteration yet")
    if log.cut_off:
        (failures if subject.has_ended else notes).append("the last line is cut off")
    failures += _results_problems(subject)
    names = list(log.lines[-1].digests) if log.lines else []
    text = f"{len(log.lines)} iterations from 0 on; digests of {', '.join(names) or 'nothing'}"
    return Check("iterations", text, failures, notes)


def _results_problems(subject: Subject) -> Iterator[str]:
    """Hold the manifest's results against the last iteration."""
    results, lines = subject.manifest.results, subject.log.lines
    if not subject.has_ended or not lines or subject.log.problems:
        return
    if results.get("iterations", len(lines)) != len(lines):
        yield f"the manifest says {results['iterations']} iterations, the log has {len(lines)}"
        return
    for name, value in results.items():
        if name in lines[-1].scalars and lines[-1].scalars[name] != value:
            yield f"the manifest says {name} {value}, the last iteration {lines[-1].scalars[name]}"


def checkpoints(subject: Subject) -> Check:
    """Load every checkpoint, and hold it against its name and the log."""
    paths = subject.run.checkpoints()
    if not paths:
        last = subject.manifest.results.get("checkpoint")
        missing = ["a finished run has no checkpoint"] if subject.status == "finished" or last else []
        return Check("checkpoints", "none", missing)
    failures: list[str] = []
    notes: list[str] = []
    agreed = 0
    for path in paths:
        problems, compared = _checkpoint_problems(subject, path)
        failures += [f"{path.name} {problem}" for problem in problems]
        agreed += bool(compared) and not problems
    if agreed + len({failure.split()[0] for failure in failures}) < len(paths):
        notes.append("the digests of the log have another definition, so the others were only loaded")
    last = subject.manifest.results.get("checkpoint")
    if subject.has_ended and last and last != paths[-1].name:
        failures.append(f"the manifest says that the last one is {last}, the last one here is {paths[-1].name}")
    return Check("checkpoints", f"{len(paths)} load; {agreed} agree with the digests of the log", failures, notes)


def _checkpoint_problems(subject: Subject, path: Path) -> tuple[list[str], list[str]]:
    """Return what is wrong with a checkpoint, and the digests that it was held against."""
    from wheelleg_exp.rl import checkpoint, digests

    iteration = checkpoint_iteration(path)
    try:
        state = checkpoint.load(path, finite=False)
    except RunDirectoryError as error:
        return [error.message], []
    problems = [] if state["iter"] == iteration else [f"is of iteration {state['iter']}"]
    if iteration >= len(subject.log.lines):
        return [*problems, "is of an iteration that the log does not have"], []
    line = subject.log.lines[iteration]
    if line.digest_format != digests.FORMAT:
        return problems, []
    found = digests.of_state(state)
    differing = [name for name in found if line.digests.get(name) not in (None, found[name])]
    if differing:
        problems.append(f"does not agree with the log's digests of {', '.join(differing)}")
    return problems, list(found)


def failure(subject: Subject) -> Check:
    """Check that what the run keeps of its failure can be read, and is what the manifest says."""
    entry, path = subject.data.get("failure"), subject.run.path / FAILURE
    if entry is None:
        return Check("failure", "none")
    try:
        with zipfile.ZipFile(path) as archive:
            require_bounded(archive)
        with np.load(path, allow_pickle=False) as arrays:
            about = require_mapping(json_value(str(arrays["about"])), path)
            text = f"{entry['key']} in iteration {entry['iteration']}: {len(arrays.files) - 1} arrays"
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        return Check("failure", "", [f"{FAILURE} cannot be read: {error}"])
    differing = [key for key in ("key", "iteration", "message") if about.get(key) != entry.get(key)]
    return Check("failure", text, [f"{FAILURE} and the manifest differ in {', '.join(differing)}"] if differing else [])


def recording(subject: Subject) -> Check:
    """Check that the recording can be read and was closed."""
    path = subject.run.recording
    if not path.exists():
        return Check("recording", "", skipped="the run has none")
    from wheelleg_exp.recording.reading.contents import Contents

    contents = Contents(path)
    health = contents.health
    told = health.lines()[1:]
    text = f"{len(contents.pieces)} entities in {health.messages} messages, {health.size / 1e6:.1f} MB"
    if health.damaged or (subject.has_ended and health.readable < health.size):
        return Check("recording", text, told)
    if subject.has_ended and not health.is_closed:
        return _unfinished(subject, text, told)
    return Check("recording", text, notes=told)


def _unfinished(subject: Subject, text: str, told: list[str]) -> Check:
    """Tell a recording without an index: whole, when its bytes are those that the run left; else who knows what."""
    record = subject.manifest.recorded_files().get(subject.run.recording.name)
    if record is None or record["sha256"] != sha256(subject.run.recording):
        return Check("recording", text, told)
    why = subject.data.get("recording_unfinished")
    reason = f" ({why})" if isinstance(why, str) else ""
    note = "it is as the run left it, and lacks nothing but the index that makes it quick to open"
    return Check("recording", text, notes=[f"{note}{reason}: 'wheelleg inspect RUN --repair' writes a copy with one"])


def exported(subject: Subject) -> Check:
    """Check that the exported policy can be read."""
    folder = subject.run.exported
    names = sorted(path.name for path in folder.iterdir() if path.is_file()) if folder.is_dir() else []
    if not names:
        return Check("exported", "", skipped="the run exported no policy")
    failures = []
    if "policy.pt" in names and _archive_problem(folder / "policy.pt"):
        failures.append("exported/policy.pt is damaged")
    if "policy.json" in names and not isinstance(read_json(folder / "policy.json"), Mapping):
        failures.append("exported/policy.json describes no policy")
    return Check("exported", ", ".join(names), failures)


def _archive_problem(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            require_bounded(archive)
            return archive.testzip() is not None
    except Exception:  # a damaged archive may fail in any way
        return True
