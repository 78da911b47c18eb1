"""Find and read the files of an imported folder. Nothing in these files is executed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.files import LARGEST_YAML, read_bytes
from wheelleg_exp.jobs.export.isaaclab_run import Tree
from wheelleg_exp.plain_data import Unreadable, tagged_yaml_value
from wheelleg_exp.run.run_config import require_resolved

_CHECKPOINT = re.compile(r"model_(\d+)\.pt")
_POLICIES = ("policy.onnx", "policy.pt")
_DESCRIPTORS = "IO_descriptors.yaml"  # Isaac Lab's description of observations and actions
LFS = b"version https://git-lfs"
_KINDS = ("env.yaml", "deploy.yaml", "config.yaml", "params.yaml")  # of Isaac Lab, unitree_rl_lab, rl_sar, and LimX
_EXPECTED = "an Isaac Lab run with params/env.yaml, or deploy.yaml, rl_sar's config.yaml, or LimX's params.yaml"


@dataclass(frozen=True)
class RunFolder:
    """The files of an imported folder, and the order of the joints in Isaac Lab, if the run has exported it."""

    path: Path
    kind: str
    config: Tree
    config_file: Path
    agent: Tree | None
    policy: Path | None
    joint_order: list[str] | None


def read_folder(path: Path, policy: Path | None = None) -> RunFolder:
    """Read an imported folder. ``policy`` replaces the policy that the folder contains."""
    if not path.exists():
        siblings = [item.name for item in path.parent.iterdir()] if path.parent.is_dir() else []
        near = nearest_name(path.name, siblings)
        nearest = str(path.with_name(near)) if near else None
        raise RunDirectoryError("the folder does not exist", key=str(path), expected=_EXPECTED, nearest=nearest)
    folder = path.parent if path.is_file() else path
    places = [path.name] if path.is_file() else [f"{below}{kind}" for kind in _KINDS for below in ("params/", "")]
    file = next((folder / place for place in places if (folder / place).is_file()), None)
    if file is None or file.name not in _KINDS:
        raise RunDirectoryError("the folder contains no run", key=str(path), expected=_EXPECTED)
    root = file.parent.parent if file.parent.name == "params" else file.parent
    agent = file.with_name("agent.yaml")
    if policy is not None and not policy.is_file():
        raise RunDirectoryError("there is no such file", key=f"--policy {policy}", expected="a policy file")
    content = read_mapping(agent) if agent.is_file() else None
    config = read_mapping(file)
    described = next((p for below in ("io_descriptors/", "") if (p := root / f"{below}{_DESCRIPTORS}").is_file()), None)
    robots = None if described is None else read_mapping(described).get("articulations")
    robot = next(iter(robots.values()), None) if isinstance(robots, Mapping) else None
    names = robot.get("joint_names") if isinstance(robot, Mapping) else None
    order = names if isinstance(names, list) else None
    return RunFolder(root, file.name, config, file, content, policy or _policy(root, config), order)


def read_names(path: Path) -> dict[str, str]:
    """Return the content of a file that maps names to names."""
    expected = "lines such as 'FL_hip: front_left_hip'"
    names = read_mapping(path, expected)
    found = {old: new for old, new in names.items() if isinstance(old, str) and isinstance(new, str)}
    if wrong := [f"{old!r}: {new!r}" for old, new in names.items() if old not in found]:
        raise RunDirectoryError(f"{wrong[0]} is not a pair of names", key=str(path), expected=expected)
    return found


def _policy(root: Path, config: Mapping[str, object]) -> Path | None:
    """Return a folder's policy: the newest checkpoint, an exported policy, or the one that rl_sar names."""
    files = filter(Path.is_file, root.iterdir())
    numbered = {int(found[1]): file for file in files if (found := _CHECKPOINT.fullmatch(file.name))}
    if numbered:
        return numbered[max(numbered)]
    places = [root / below / name for below in ("exported", "", "policy/isaaclab", "policy") for name in _POLICIES]
    listed = [value.get("model_name") for value in config.values() if isinstance(value, Mapping)]
    named = [name for name in listed if isinstance(name, str) and name]
    places += [root / Path(name).name for name in named]
    policy = next((place for place in places if place.is_file()), None)
    if policy is None and named:
        message, expected = f"the folder has no policy {named[0]!r}", "the file in this folder, or --policy FILE"
        raise RunDirectoryError(message, key="model_name", where=str(root / "config.yaml"), expected=expected)
    return policy


def read_mapping(path: Path, expected: str = _EXPECTED) -> Tree:
    """Return the content of a YAML file that must be a mapping."""
    data = read_bytes(path, LARGEST_YAML)
    if data.startswith(LFS):
        raise RunDirectoryError("the file is a pointer of Git LFS", key=str(path), expected="git lfs pull")
    try:
        value = tagged_yaml_value(data)
    except Unreadable as error:
        where = str(path) if error.line is None else f"{path}:{error.line}"
        raise RunDirectoryError(f"the YAML file cannot be read: {error.problem}", where=where) from error
    if not isinstance(value, Mapping):
        raise RunDirectoryError("the file contains no mapping", key=str(path), expected=expected)
    require_resolved(value, str(path))  # The imported config is composed, which would resolve ``${...}``.
    return dict(value)


def malformed(path: Path, error: Exception) -> WheellegError:
    """Return the error for a config whose values have other types than its author writes."""
    text = " ".join(str(error).split())[:160]
    message = f"the file does not have the usual structure ({type(error).__name__}: {text})"
    expected = "the file as Isaac Lab, unitree_rl_lab, rl_sar, or LimX writes it"
    return RunDirectoryError(message, key=str(path), expected=expected)
