"""What a run was made with, and what this process has: a difference ends the claim that a resume is exact."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.jobs.train.source_roots import installed_roots, loaded_outside
from wheelleg_exp.packages import read_project
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.run import environment
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.recorded import recorded_config
from wheelleg_exp.run.source.restore import load_source
from wheelleg_exp.run.source.snapshot import snapshot_source
from wheelleg_exp.run.source_changes import changes_in_words
from wheelleg_exp.trusted_folders import is_trusted, real
from wheelleg_exp.verify.made_with import FactDifference, environment_differences

_SHOWN = 60


def brief(value: Any) -> str:
    """Return a value as a text that fits a line."""
    text = str(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def require_variables(run: RunDirectory, variables: Mapping[str, str]) -> dict[str, Any]:
    """Return the config that a replay trains with; it runs the run's own code in this environment, and may ask it.

    Args:
        run: the run.
        variables: those that the run has kept; others are taken from this process.

    Raises:
        RunDirectoryError: it asks for a variable that was not kept and is not set, or cannot be resolved.
    """
    return recorded_config(run, {**os.environ, **variables})


def differences_now(run: RunDirectory, threads: Mapping[str, Any], config_dirs: Sequence[Path]) -> list[FactDifference]:
    """Return in what source, versions, hardware, threads and variables this process differs from a run's.

    Differences that cannot change a number are left out.

    Args:
        run: the run.
        threads: what ``set_threads`` returned here.
        config_dirs: the user's config folders in use.
    """
    now = {
        "versions": environment.versions(),
        "hardware": environment.hardware(),
        "threads": threads,
        "environment_variables": environment.variables(),
    }
    facts = environment_differences(run.manifest().data, now)
    return _source(run, config_dirs) + [fact for fact in facts if fact.section == "versions" or fact.allows]


def _source(run: RunDirectory, config_dirs: Sequence[Path]) -> list[FactDifference]:
    recorded = _records(load_source(run))
    with tempfile.TemporaryDirectory() as folder:
        present = _records(snapshot_source(_roots(run, config_dirs), Path(folder), runs_root=run.root))
    found = []
    for number in range(max(len(recorded), len(present))):
        was, now = (side[number] if number < len(side) else {} for side in (recorded, present))
        (key, before), (key_now, after) = _identity(was), _identity(now)
        if (key, before) != (key_now, after) or not before:
            note = changes_in_words(was, now, [Path(now["root"])] if now.get("root") else [])
            name = f"{key if key == key_now else 'source'} ({number + 1})"
            found.append(FactDifference("source", name, before or key, after or key_now, note=note))
    return found


def _records(content: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return [content, *content["others"]]


def _identity(record: Mapping[str, Any]) -> tuple[str, str]:
    """Return what identifies the files of a recorded repository or folder."""
    if not record:
        return "(not kept)", ""
    key = "tree" if record["tree"] else "content_sha256"
    return key, str(record.get(key) or "")


def _roots(run: RunDirectory, config_dirs: Sequence[Path]) -> list[Path]:
    """Return the present places of the run's source roots: this package's, then the projects of the config folders.

    Other recorded folders count only if they are trusted or this process uses them: installed, or imported by now.
    """
    projects = [folder.parent if read_project(folder.parent) else folder for folder in config_dirs]
    content = load_source(run)
    recorded = [
        Path(record["root"]) / name
        for record in (content, *content["others"])
        for name in record["folders"]
        if record["root"] is not None
    ]
    known = [configs_dir().parent, *projects]
    used = {real(path) for path in [*loaded_outside(known), *installed_roots()]}
    return [*known, *(p for p in recorded[1:] if (real(p) in used or is_trusted(p)) and p.exists())]
