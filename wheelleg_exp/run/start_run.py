"""Write the files that a run directory contains before the first step: parameters, config, source, and manifest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from wheelleg_exp.config.schema import RunOptions
from wheelleg_exp.files import write_text
from wheelleg_exp.run.environment import environment_text, requested_variables, variables
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import require_resolved, write_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_snapshot import snapshot_source

_SUMMARY = ("status", "exact", "root", "commit", "branch", "tree", "dirty", "note")


def start_run(
    directory: RunDirectory,
    *,
    command: Sequence[str],
    params: Mapping[str, object],
    hydra_files: Mapping[str, str],
    source_roots: Sequence[Path],
    seed: int | Sequence[int],
    task: str,
    threads: Mapping[str, object],
    max_patch_mb: float | None = None,
) -> Manifest:
    """Write the manifest of a new run with the status ``running``, and then the snapshot of the run's inputs.

    The manifest comes first, so that ``wheelleg list`` shows even a run that is killed at its start. ``hydra_files``
    contains the text of each Hydra file by name, such as ``config.yaml``. The first of ``source_roots`` is the folder
    of ``wheelleg_exp``. The caller must record the run's end in the returned manifest.
    """
    require_resolved(params)
    manifest = Manifest.begin(directory.path, task=task, seed=seed, command=command, threads=threads)
    with manifest.failing():
        write_params(directory.path, params)
        for name, text in hydra_files.items():
            write_text(directory.hydra / name, text)
        # Store the environment variables that the config requests, so that later commands can resolve the config.
        requested = requested_variables(hydra_files.values())
        found = variables(also=requested)
        manifest.record(config_variables={name: found[name] for name in requested if name in found})
        complete_snapshot(directory, manifest, source_roots, threads, max_patch_mb)
    return manifest


def complete_snapshot(
    directory: RunDirectory,
    manifest: Manifest,
    source_roots: Sequence[Path],
    threads: Mapping[str, object],
    max_patch_mb: float | None = None,
) -> None:
    """Write the source snapshot and ``environment.txt`` into a run directory, and record both in the manifest."""
    # `wheelleg resume` also calls ``complete_snapshot``, for a run that was killed before its snapshot was complete.
    cap = RunOptions().max_patch_mb if max_patch_mb is None else max_patch_mb
    source = snapshot_source(source_roots, directory.source, runs_root=directory.root, max_patch_mb=cap)
    write_text(directory.environment, environment_text(threads))
    manifest.record(source={key: getattr(source[0], key) for key in _SUMMARY}, files=inventory(directory.path))
