"""What decided the run: parameters, source, robot."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.config.tree import Keys
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, read_text, read_yaml, sha256
from wheelleg_exp.run.params import PARTS, load_params
from wheelleg_exp.run.recorded import CONFIG, ROBOT, resolved
from wheelleg_exp.run.source.snapshot import RECORD_NAME, entries
from wheelleg_exp.terms.binding import drop_removed
from wheelleg_exp.verify.checked_run import Check, Subject
from wheelleg_exp.verify.comparison_text import changes_text
from wheelleg_exp.verify.settings import plain_changes

# Resolvers whose answer depends on where and when one asks.
_OUTSIDE = re.compile(r"\$\{\s*(oc\.env|now|hydra)\s*:")


@dataclass(frozen=True)
class _Config:
    """Hydra's config: as written; resolved and without removed terms; and whether it asks the surroundings."""

    written: dict[str, Any]
    resolved: dict[str, Any]
    asks: bool


def params(subject: Subject) -> Check:
    """Hold the parameters against the config that they came from, and seed and task against the manifest."""
    if not subject.has_snapshot:
        return Check("params", "", skipped="the run broke off while its snapshot was written")
    found = dict(zip(PARTS, load_params(subject.run), strict=True))
    drop_removed(found)
    text = "env.yaml and agent.yaml are the config's env and agent"
    config = _config(subject.run.path / CONFIG, subject.data.get("config_variables"))
    if isinstance(config, str):
        return Check("params", text, skipped=config)
    failures, notes = list(_identity_problems(subject, config.resolved)), []
    for part in PARTS:
        changes = plain_changes(found[part], config.resolved.get(part), (part,))
        open_ones = [change for change in changes if config.asks and _is_interpolated(config.written, change.keys)]
        changes = [change for change in changes if change not in open_ones]
        if changes:
            failures.append(f"params/{part}.yaml is not the config's {part}: {changes_text(changes)}")
        notes += [f"{change.key} depended on where the run was made, and was not checked" for change in open_ones]
    return Check("params", text, failures, notes)


def _identity_problems(subject: Subject, config: Mapping[str, Any]) -> Iterator[str]:
    seeds, task = subject.data.get("seeds"), config.get("task")
    if seeds and config.get("seed") is not None and config["seed"] != seeds[0]:
        yield f"the config's seed is {config['seed']}, the manifest's {seeds[0]}"
    if isinstance(task, Mapping) and task.get("name") != subject.data["task"]:
        yield f"the config's task is '{task.get('name')}', the manifest's '{subject.data['task']}'"


def _config(path: Path, variables: Mapping[str, str] | None) -> _Config | str:
    """Return Hydra's config, or why it cannot be had; recorded environment variables have their old values."""
    if not path.is_file():
        return f"there is no {CONFIG} to hold them against"
    tree = read_yaml(path)
    if not isinstance(tree, dict):
        return f"{CONFIG} is no mapping"
    try:
        kept = resolved(tree, variables or {}, _unknown)
    except RunDirectoryError as error:
        return f"{CONFIG} {error.message}"
    asks = _OUTSIDE.search(read_text(path)) is not None
    drop_removed(kept)
    return _Config(tree, kept, asks)


def _unknown(_variable: str) -> None:
    """Return the value of a variable that was not kept: settings that depend on it are not checked."""


def _is_interpolated(tree: Any, keys: Keys) -> bool:
    """Return whether the value at some keys is written as an interpolation, or lies in one."""
    for name in keys:
        if isinstance(tree, str):
            break
        tree = tree.get(name) if isinstance(tree, Mapping) else None
    return "${" in str(tree)


def source(subject: Subject) -> Check:
    """Hold the record of the source against the manifest, and the patches against the record."""
    if not subject.has_snapshot:
        return Check("source", "", skipped="the run broke off while its snapshot was written")
    path = subject.run.source / RECORD_NAME
    if not path.is_file():
        return Check("source", "", [f"there is no source/{RECORD_NAME}"])
    record = read_json(path)
    if not isinstance(record, Mapping):
        return Check("source", "", [f"source/{RECORD_NAME} describes no source"])
    summary = subject.data.get("source") or {}
    failures = [
        f"{key} is {record.get(key)} in source/{RECORD_NAME} and {value} in the manifest"
        for key, value in summary.items()
        if key in ("status", "commit", "tree", "dirty") and record.get(key) != value
    ]
    records = entries(record)
    failures += [problem for one in records for problem in _patch_problems(subject.run.source, one)]
    notes = [f"{one.get('status')}: {one['note']}" for one in records if one.get("note")]
    return Check(
        "source", f"commit {str(record.get('commit'))[:10]}, tree {str(record.get('tree'))[:10]}", failures, notes
    )


def _patch_problems(folder: Path, record: Mapping[str, Any]) -> Iterator[str]:
    name = record.get("patch")
    if not isinstance(name, str):
        return
    path = folder / Path(name).name
    if not path.is_file():
        yield f"source/{name} is missing"
        return
    if sha256(path) != record.get("patch_sha256"):
        yield f"source/{name} is not the patch that source/{RECORD_NAME} describes"


def asset(subject: Subject) -> Check:
    """Check that the robot is there, and which one it is."""
    identity = subject.run.path / ROBOT
    if not identity.is_file():
        return Check("asset", "", skipped="the run kept no robot")
    known = read_json(identity)
    sources = known.get("sources") if isinstance(known, Mapping) else None
    model = known.get("model_sha256") if isinstance(known, Mapping) else None
    failures = [] if (subject.run.asset / "robot.xml").is_file() else ["asset/robot.xml is missing"]
    if not isinstance(model, str) or not re.fullmatch(r"[0-9a-f]{64}", model):
        failures.append(f"{ROBOT} has no digest of the compiled model")
    return Check("asset", f"{len(sources or ())} source files, compiled model {str(model)[:10]}", failures)
