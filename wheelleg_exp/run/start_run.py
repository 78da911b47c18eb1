"""Write what a run directory contains before the first step: parameters, config, source, environment, manifest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import write_text
from wheelleg_exp.run.environment import environment_text, requested_variables, variables
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import require_resolved, write_params
from wheelleg_exp.run.run_directory import RunDirectory, RunOptions
from wheelleg_exp.run.source_snapshot import snapshot_source

_HYDRA_NAME = re.compile(r"[A-Za-z0-9_-]+(\.yaml)?")
_SUMMARY = ("status", "exact", "root", "commit", "branch", "tree", "dirty", "note")


def start_run(
    directory: RunDirectory,
    *,
    command: Sequence[str],
    params: Mapping[str, dict[str, Any]],
    hydra_files: Mapping[str, str],
    source_roots: Sequence[Path],
    seed: int | Sequence[int],
    task: str,
    threads: Mapping[str, Any],
    max_patch_mb: float | None = None,
) -> Manifest:
    """Write the manifest (status ``running``) of a run that is about to start, then its snapshot.

    The manifest exists before the source is read, so that a run that is killed meanwhile is visible.

    Args:
        directory: a new run directory.
        command: the command line.
        params: plain ``env`` and ``agent`` parameters.
        hydra_files: text by file name (``config``, ``hydra``, ``overrides``, with or without ``.yaml``).
        source_roots: source folders, the package's own first.
        seed: the seed or seeds.
        task: the task's name.
        threads: the thread policy, and torch's description of the CPU.
        max_patch_mb: see ``RunOptions``.

    Returns:
        The manifest, which the caller finishes.

    Raises:
        RunDirectoryError: a parameter is not plain or contains ``${``, or the directory already contains a run.
    """
    require_resolved(params)
    hydra_paths = {directory.hydra / _hydra_name(name): text for name, text in hydra_files.items()}
    manifest = Manifest.begin(directory.path, task=task, seed=seed, command=command, threads=threads)
    with manifest.failing():
        write_params(directory.path, params)
        for path, text in hydra_paths.items():
            write_text(path, text)
        manifest.record(config_variables=_config_variables(hydra_files))
        complete_snapshot(directory, manifest, source_roots, threads, max_patch_mb)
    return manifest


def complete_snapshot(
    directory: RunDirectory,
    manifest: Manifest,
    source_roots: Sequence[Path],
    threads: Mapping[str, Any],
    max_patch_mb: float | None = None,
) -> None:
    """Write the second part of the snapshot, after parameters and configs: source and distributions.

    A run that was killed before this part was written has computed nothing. A resume completes its snapshot.
    """
    cap = RunOptions().max_patch_mb if max_patch_mb is None else max_patch_mb
    source = snapshot_source(source_roots, directory.source, runs_root=directory.root, max_patch_mb=cap)
    write_text(directory.environment, environment_text(threads))
    manifest.snapshot_taken({key: source[key] for key in _SUMMARY})


def _config_variables(hydra_files: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that the config requests with ``${oc.env:NAME}`` and that are set.

    The stored config contains ``${oc.env:NAME}``. With these variables it resolves to the same values again.
    """
    requested = requested_variables(hydra_files.values())
    found = variables(also=requested)
    return {name: found[name] for name in requested if name in found}


def _hydra_name(name: str) -> str:
    if not _HYDRA_NAME.fullmatch(name):
        raise RunDirectoryError(f"'{name}' is not a file name for .hydra", expected="config, hydra or overrides")
    return name if name.endswith(".yaml") else f"{name}.yaml"
