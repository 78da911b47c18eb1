"""Check whether the files of one run agree with the run's manifest and with each other."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, read_text, read_yaml, require_mapping, sha256
from wheelleg_exp.plain_data import json_value, require_bounded
from wheelleg_exp.run.file_inventory import odd_entries
from wheelleg_exp.run.iteration_log import comparable_digests
from wheelleg_exp.run.run_config import CONFIG, PARTS, ROBOT, load_params, recorded_robot, resolved
from wheelleg_exp.run.run_directory import FAILURE, RunDirectory, checkpoint_iteration
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.run.source_snapshot import RECORD_NAME
from wheelleg_exp.terms.key_syntax import Keys
from wheelleg_exp.terms.term_binding import drop_removed
from wheelleg_exp.verify import check_files
from wheelleg_exp.verify.check_files import Check, RunFindings, Subject
from wheelleg_exp.verify.run_differences import changes_text, plain_changes

# The OmegaConf resolvers whose values depend on the computer or the time.
_OUTSIDE = re.compile(r"\$\{\s*(oc\.env|now|hydra)\s*:")


def params(subject: Subject) -> Check:
    """Compare the parameter files with the run's config, and the config's seed and task with the manifest."""
    if not subject.has_snapshot:
        return Check("params", "", skipped="the run stopped while its snapshot was written")
    found = dict(zip(PARTS, load_params(subject.run), strict=True))
    drop_removed(found)
    text, path = "env.yaml and agent.yaml are the config's env and agent", subject.run.path / CONFIG
    if not path.is_file():
        return Check("params", text, skipped=f"there is no {CONFIG} to compare with")
    written = read_yaml(path)
    if not isinstance(written, dict):
        return Check("params", text, skipped=f"{CONFIG} is not a mapping")
    try:
        # An environment variable that the run's manifest lacks resolves to None.
        config = resolved(written, subject.facts.config_variables or {}, lambda _: None)
    except RunDirectoryError as error:
        return Check("params", text, skipped=f"{CONFIG}: {error.message}")
    drop_removed(config, written)
    depends_on_machine = _OUTSIDE.search(read_text(path)) is not None
    failures, notes = [], []
    seeds, task = subject.facts.seeds, config.get("task")
    if seeds and config.get("seed") not in (None, seeds[0]):
        failures.append(f"the config's seed is {config['seed']}, the manifest's {seeds[0]}")
    if isinstance(task, Mapping) and task.get("name") != subject.facts.task:
        failures.append(f"the config's task is '{task.get('name')}', the manifest's '{subject.facts.task}'")
    for part in PARTS:
        changes = plain_changes(found[part], config.get(part), (part,))
        unknown = [change for change in changes if depends_on_machine and _is_interpolated(written, change.keys)]
        changes = [change for change in changes if change not in unknown]
        if changes:
            failures.append(f"params/{part}.yaml is not the config's {part}: {changes_text(changes)}")
        notes += [f"{change.key} depends on the machine of the run, and was not checked" for change in unknown]
    return Check("params", text, failures, notes)


def _is_interpolated(tree: object, keys: Keys) -> bool:
    """Return whether a config value, given by its path, comes from an interpolation such as ``${task.name}``."""
    for name in keys:
        if isinstance(tree, str):
            break
        tree = tree.get(name) if isinstance(tree, Mapping) else None
    return "${" in str(tree)


def source(subject: Subject) -> Check:
    """Check a run's ``source/git.json`` against ``manifest.json``, and its git patches against ``source/git.json``."""
    if not subject.has_snapshot:
        return Check("source", "", skipped="the run stopped while its snapshot was written")
    folder, where = subject.run.source, f"source/{RECORD_NAME}"
    if not (folder / RECORD_NAME).is_file():
        return Check("source", "", [f"there is no {where}"])
    records, noted, failures = load_source(subject.run), subject.facts.source, []
    for key in ("status", "commit", "tree", "dirty") if noted and noted.status else ():
        one, other = getattr(records[0], key), getattr(noted, key)
        failures += [f"{key} is {one} in {where} and {other} in the manifest"] if one != other else []
    for record in records:
        if record.patch is not None and not (folder / record.patch).is_file():
            failures.append(f"source/{record.patch} is missing")
        elif record.patch is not None and sha256(folder / record.patch) != record.patch_sha256:
            failures.append(f"source/{record.patch} is not the patch that {where} describes")
    notes = [f"{record.status}: {record.note}" for record in records if record.note]
    text = f"commit {str(records[0].commit)[:10]}, tree {str(records[0].tree)[:10]}"
    return Check("source", text, failures, notes)


def asset(subject: Subject) -> Check:
    """Check that the robot's MJCF file exists, and that ``asset.json`` contains the hash of the compiled model."""
    identity = subject.run.path / ROBOT
    if not identity.is_file():
        return Check("asset", "", skipped="the run saved no robot")
    known = recorded_robot(subject.run)
    failures = [] if (subject.run.asset / "robot.xml").is_file() else ["asset/robot.xml is missing"]
    if not re.fullmatch(r"[0-9a-f]{64}", known.model_sha256):
        failures.append(f"{ROBOT} has no digest of the compiled model")
    return Check("asset", f"{len(known.sources)} source files, compiled model {known.model_sha256[:10]}", failures)


def iterations(subject: Subject) -> Check:
    """Check that a run's iteration log counts from 0 without gaps up to the last iteration in the manifest."""
    log, failures = subject.log, list(subject.log.problems)
    notes: list[str] = []
    if not subject.run.iterations.is_file() and not subject.run.checkpoints() and subject.status != "finished":
        return Check("iterations", "", skipped="the run has no iteration yet")
    if log.cut_off:
        (failures if subject.has_ended else notes).append("the last line is cut off")
    results, count = subject.manifest.results, len(log.lines)
    if subject.has_ended and log.lines and not log.problems:
        last = log.lines[-1].scalars
        if results.get("iterations", count) != count:
            failures.append(f"the manifest says {results['iterations']} iterations, the log has {count}")
        else:
            wrong = [name for name in results if name in last and last[name] != results[name]]
            failures += [f"the manifest says {n} {results[n]}, the last iteration {last[n]}" for n in wrong]
    names = list(log.lines[-1].digests) if log.lines else []
    text = f"{count} iterations from 0; digests of {', '.join(names) or 'nothing'}"
    return Check("iterations", text, failures, notes)


def checkpoints(subject: Subject) -> Check:
    """Compare each checkpoint's iteration with the file name, and each checkpoint's hashes with the iteration log."""
    paths, last = subject.run.checkpoints(), subject.manifest.results.get("checkpoint")
    if not paths:
        missing = ["a finished run has no checkpoint"] if subject.status == "finished" or last else []
        return Check("checkpoints", "none", missing)
    failures, notes = [], []
    agreed, damaged = 0, 0
    for path in paths:
        problems, compared = _checkpoint_problems(subject, path)
        failures += [f"{path.name} {problem}" for problem in problems]
        agreed += bool(compared) and not problems
        damaged += bool(problems)
    if agreed + damaged < len(paths):
        notes.append("the log's digests have another definition, so the remaining checkpoints were only loaded")
    if subject.has_ended and last and last != paths[-1].name:
        failures.append(f"the manifest's last checkpoint is {last}, the last file is {paths[-1].name}")
    return Check("checkpoints", f"{len(paths)} files; {agreed} agree with the digests of the log", failures, notes)


def _checkpoint_problems(subject: Subject, path: Path) -> tuple[list[str], list[str]]:
    """Compare a checkpoint with the iteration log; return its problems and the names of the compared hashes."""
    from wheelleg_exp.rl import checkpoint, digests

    iteration = checkpoint_iteration(path)
    try:
        state = checkpoint.load(path, finite=False)
    except RunDirectoryError as error:
        return [f"cannot be loaded: {error.message}"], []
    problems = [] if state["iter"] == iteration else [f"is of iteration {state['iter']}"]
    if iteration >= len(subject.log.lines):
        return [*problems, "is of an iteration that is not in the log"], []
    logged = comparable_digests(subject.log.lines[iteration], digests.format_of(state))
    if not logged:
        return problems, []
    found = digests.of_state(state)
    differing = [name for name in found if logged.get(name) not in (None, found[name])]
    if differing:
        problems.append(f"does not agree with the log's digests of {', '.join(differing)}")
    return problems, list(found)


def failure(subject: Subject) -> Check:
    """Check that the simulation state that a failed run saved is readable and agrees with the run's manifest."""
    entry, path = subject.facts.failure, subject.run.path / FAILURE
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
    differing = [key for key in ("key", "iteration", "message") if about.get(key) != entry[key]]
    return Check("failure", text, [f"{FAILURE} and the manifest differ in {', '.join(differing)}"] if differing else [])


def recording(subject: Subject) -> Check:
    """Check that the recording of a training is readable and complete."""
    path = subject.run.recording
    if not path.exists():
        return Check("recording", "", skipped="the run has no recording")
    from wheelleg_exp.recording.reading.recording_contents import Contents

    record = subject.manifest.recorded_files().get(path.name)
    is_recorded = record is not None and record["sha256"] == sha256(path)
    contents = Contents(path, is_changed=record is not None and not is_recorded)
    health = contents.health
    lines = health.lines()[1:]
    text = f"{len(contents.pieces)} entities in {health.messages} messages, {health.size / 1e6:.1f} MB"
    if health.damaged or (subject.has_ended and health.readable < health.size):
        return Check("recording", text, lines)
    if not subject.has_ended or health.is_closed:
        return Check("recording", text, notes=lines)
    # A recording without an index is complete if its sha256 equals the sha256 in the manifest.
    if not is_recorded:
        return Check("recording", text, lines)
    why = subject.facts.recording_unfinished
    note = "it is complete but has no index, so it opens slowly" + (f" ({why})" if why else "")
    return Check("recording", text, notes=[f"{note}: 'wheelleg inspect RUN --repair' writes a copy with one"])


def exported(subject: Subject) -> Check:
    """Check that the files of a run's exported policy are readable."""
    folder = subject.run.exported
    names = sorted(path.name for path in folder.iterdir() if path.is_file()) if folder.is_dir() else []
    if not names:
        return Check("exported", "", skipped="the run exported no policy")
    failures = []
    if "policy.pt" in names:
        try:
            with zipfile.ZipFile(folder / "policy.pt") as archive:
                require_bounded(archive)
                damaged = archive.testzip() is not None
        except Exception:  # Reading a damaged archive can raise any exception.
            damaged = True
        failures += ["exported/policy.pt is damaged"] if damaged else []
    if "policy.json" in names and not isinstance(read_json(folder / "policy.json"), Mapping):
        failures.append("exported/policy.json does not describe a policy")
    return Check("exported", ", ".join(names), failures)


_OF_THE_FILES = (check_files.manifest, check_files.files)
_OF_THE_CONTENT = (params, source, asset, iterations, checkpoints, failure, recording, exported)


def verify_run(run: RunDirectory) -> RunFindings:
    """Check whether a run's files agree with the run's manifest and each other, without executing stored code."""
    subject = check_files.read_subject(run)
    checks = [_guarded(check, subject) for check in _OF_THE_FILES]
    odd = odd_entries(run.path)
    if odd:  # A symbolic link can lead outside the run directory, and reading from a pipe may never end.
        found = [f"{name} is {what}, which may lead anywhere" for name, what in odd.items()]
        checks.append(Check("entries", "", found))
        skipped = "the run holds other entries than files and folders"
        checks += [Check(check.__name__, "", skipped=skipped) for check in _OF_THE_CONTENT]
    else:
        checks += [_guarded(check, subject) for check in _OF_THE_CONTENT]
    return RunFindings(run.path, subject.status, checks)


def _guarded(check: Callable[[Subject], Check], subject: Subject) -> Check:
    """Run one check. If a check cannot read a file, the check fails, and the remaining checks of the run continue."""
    try:
        if subject.is_shipped and check in (source, iterations, checkpoints):
            return Check(check.__name__, "", skipped="a policy that ships with wheelleg_exp has no log and no source")
        return check(subject)
    except RunDirectoryError as error:
        return Check(check.__name__, "", [str(error)])
    except Exception as error:  # Reading a damaged file can raise any exception.
        return Check(check.__name__, "", [f"it cannot be checked: {type(error).__name__}: {error}"])
