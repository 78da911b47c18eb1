"""Write what a run directory contains before the first step: parameters, config, source, environment, manifest."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import write_text
from wheelleg_exp.run.environment import environment_text, requested_variables, variables
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_config import require_resolved, write_params
from wheelleg_exp.run.run_directory import RunDirectory, RunOptions
from wheelleg_exp.run.secrecy import secret_content, secret_keys, secret_variables
from wheelleg_exp.run.source_snapshot import snapshot_source

_HYDRA_NAME = re.compile(r"[A-Za-z0-9_-]+(\.yaml)?")
_NO_SECRETS = "no keys or tokens in a config; let the code that needs one read it from the environment"
_SUMMARY = ("status", "root", "commit", "branch", "tree", "dirty", "note")


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

    A run that is killed while its source is read can thus be seen, and a snapshot that fails says so. What would be
    kept has been looked through for secrets before (``refuse_secrets``).

    Args:
        directory: a directory that was just created.
        command: the command line.
        params: plain ``env`` and ``agent`` parameters.
        hydra_files: text by file name (``config``, ``hydra``, ``overrides``, with or without ``.yaml``).
        source_roots: folders whose source matters, the package's own first.
        seed: the seed or seeds.
        task: the task's name.
        threads: the thread policy, and what torch says of the CPU.
        max_patch_mb: see ``RunOptions``.

    Returns:
        The manifest, to be finished by the caller.

    Raises:
        RunDirectoryError: a parameter is not plain or holds ``${``, or the directory holds a run already.
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
    """Write the rest of the snapshot, behind parameters and configs: source and distributions.

    A run that was killed before this was done has computed nothing, and can be completed when it is gone on with.
    """
    cap = RunOptions().max_patch_mb if max_patch_mb is None else max_patch_mb
    source = snapshot_source(source_roots, directory.source, runs_root=directory.root, max_patch_mb=cap)
    write_text(directory.environment, environment_text(threads))
    manifest.snapshot_taken({key: source[key] for key in _SUMMARY})


def _config_variables(hydra_files: Mapping[str, str]) -> dict[str, str]:
    """Return the environment variables that the config asks for and that are set.

    The config is kept as it is written, ``${oc.env:NAME}`` included; with these it gives the same values again.
    """
    asked = requested_variables(hydra_files.values())
    told = variables(also=asked)
    return {name: told[name] for name in asked if name in told}


def refuse_secrets(
    command: Sequence[str],
    texts: Mapping[str, str] | None = None,
    config: Mapping[str, Any] | None = None,
    kept: Mapping[str, Any] | None = None,
) -> None:
    """Refuse to write down what looks like a key or a token, or would become one: run directories are handed on.

    Args:
        command: the command line.
        texts: further texts that are kept as they are written, by name: configs and overrides.
        config: the resolved config.
        kept: a resolved config that stands in the run already; what it holds is not asked about again.

    Raises:
        ConfigError: a text is one, the name of its key says so, or ``${oc.env:NAME}`` asks for a variable of such a
            name, so that its value would be written.
    """
    named = {"the command line": "\n".join(command), **(texts or {})}
    for place, text in named.items():
        for variable in secret_variables(text):
            raise ConfigError(
                f"${{oc.env:{variable}}} would bring the value of {variable} into the run directory, and its name says "
                "that it is a secret",
                key=place,
                expected=_NO_SECRETS,
            )
    known = set(secret_keys(kept or {}))
    found = [entry for entry in secret_keys(config or {}) if entry not in known]
    found += [(place, reason) for place, text in named.items() if (reason := secret_content(os.fsencode(text)))]
    for key, reason in found:
        raise ConfigError(f"this would be kept in the run directory, and {reason}", key=key, expected=_NO_SECRETS)


def _hydra_name(name: str) -> str:
    if not _HYDRA_NAME.fullmatch(name):
        raise RunDirectoryError(f"'{name}' is no file name for .hydra", expected="config, hydra or overrides")
    return name if name.endswith(".yaml") else f"{name}.yaml"
