"""What a run was made with, and what this process has: a difference ends the claim that a resume is exact."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.projects import read_project
from wheelleg_exp.run import environment
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.files import read_yaml
from wheelleg_exp.run.restore import load_source
from wheelleg_exp.run.secrecy import is_secret_variable
from wheelleg_exp.run.source import snapshot_source
from wheelleg_exp.run.verification.environment import FactDifference, environment_differences

_SECTIONS = ("seed", "task", "recording", "run")  # of which a run keeps no resolved copy
_NOT_SET = re.compile(r"Environment variable '(\w+)' not found")
_SHOWN = 60


def brief(value: Any) -> str:
    """Return a value as a text that fits a line."""
    text = str(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


def require_variables(run: RunDirectory, variables: Mapping[str, str]) -> None:
    """Refuse a run whose config asks for an environment variable that was not kept and is not set.

    Args:
        run: the run.
        variables: those that the run has kept; others are taken from this process.

    Raises:
        RunDirectoryError: it names the variable, and why it was not kept.
    """
    path = run.hydra / "config.yaml"
    config = OmegaConf.create(read_yaml(path))
    with environment.as_recorded(variables):
        for name in filter(None, (_variable_not_set(config, key) for key in _SECTIONS)):
            why = " because its name says that it holds a secret" if is_secret_variable(name) else ""
            raise RunDirectoryError(
                f"asks for the environment variable {name}, which was not kept with the run{why}, and is not set here",
                key=str(path),
                expected=f"{name} set to what it was when the run began",
            )


def _variable_not_set(config: DictConfig, section: str) -> str | None:
    """Return the environment variable for want of which a section cannot be resolved; other errors are told later."""
    try:
        value = OmegaConf.select(config, section)
        if OmegaConf.is_config(value):
            OmegaConf.to_container(value, resolve=True)
    except OmegaConfBaseException as error:
        match = _NOT_SET.search(str(error))
        return match[1] if match else None
    return None


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
    recorded = _identities(load_source(run))
    with tempfile.TemporaryDirectory() as folder:
        present = _identities(snapshot_source(_roots(run, config_dirs), Path(folder), runs_root=run.root))
    missing = ("(not kept)", "")
    found = []
    for number in range(max(len(recorded), len(present))):
        was, is_now = (side[number] if number < len(side) else missing for side in (recorded, present))
        if was != is_now or not was[1]:
            name = was[0] if was[0] == is_now[0] else "source"
            found.append(FactDifference("source", f"{name} ({number + 1})", was[1] or was[0], is_now[1] or is_now[0]))
    return found


def _identities(content: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what identifies the files of each recorded repository or folder."""
    pairs = []
    for record in (content, *content["others"]):
        key = "tree" if record["tree"] else "content_sha256"
        pairs.append((key, str(record.get(key) or "")))
    return pairs


def _roots(run: RunDirectory, config_dirs: Sequence[Path]) -> list[Path]:
    """Return the present places of the run's source roots: this package's, then the projects of the config folders.

    Other recorded folders, such as those of modules that were imported, are looked for where they were.
    """
    projects = [folder.parent if read_project(folder.parent) else folder for folder in config_dirs]
    content = load_source(run)
    recorded = [
        Path(record["root"]) / name
        for record in (content, *content["others"])
        for name in record["folders"]
        if record["root"] is not None
    ]
    others = [path for path in recorded[1:] if path.exists()]
    return [configs_dir().parent, *projects, *others]
