"""Makes a project: everything is written beside its place, checked, and then moved there whole."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp import projects
from wheelleg_exp.config.collect import find_mistakes
from wheelleg_exp.config.compose import compose
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.errors import AssetError, nearest_name
from wheelleg_exp.paths import configs_dir, find_asset
from wheelleg_exp.project.files import copy_robot
from wheelleg_exp.project.names import NameTaken, require_name
from wheelleg_exp.project.robot_yaml import robot_yaml
from wheelleg_exp.project.survey import Survey, survey
from wheelleg_exp.project.task_yaml import config_files
from wheelleg_exp.project.template import project_files, write
from wheelleg_exp.run.files import for_people


@dataclass(frozen=True)
class Created:
    """A project that was made.

    Attributes:
        path: its folder.
        name: its name, which is its package's, its task's and its robot's.
        files: what it holds, relative to ``path``.
        robot: what was found out about the robot.
    """

    path: Path
    name: str
    files: list[Path]
    robot: Survey


def create(place: Path, source: Path | None = None) -> Created:
    """Make a project.

    Args:
        place: the folder to make; its last part is the project's name.
        source: the robot's USD or URDF; by default the stock robot.

    Raises:
        WheellegError: the name or the place is not good, or the robot's file is not; nothing has been made.
    """
    path = Path(place).expanduser().absolute()
    name = path.name
    require_name(name)
    _require_place(path)
    if source is not None:
        _require_source(source)
    with for_people(path), tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{name}.making.") as scratch:
        draft = Path(scratch) / name
        draft.mkdir()
        robot = _fill(draft, name, source)
        files = sorted(file.relative_to(draft) for file in draft.rglob("*") if file.is_file())
        _require_free(path)
        draft.rename(path)
    return Created(path, name, files, robot)


def _require_place(path: Path) -> None:
    _require_free(path)
    if not path.parent.is_dir():
        raise NameTaken("there is no such folder to make a project in", key=str(path.parent))
    home = configs_dir().parent
    if (home / projects.FILE).is_file() and path.resolve().is_relative_to(home.resolve()):
        beside = Path(os.path.relpath(home.parent / path.name))
        raise NameTaken(
            "a project of your own does not stand inside wheelleg_exp itself", key=str(path), nearest=str(beside)
        )


def _require_free(path: Path) -> None:
    if os.path.lexists(path):
        raise NameTaken("is there already, and nothing is overwritten", key=str(path), expected="a new name")


def _require_source(source: Path) -> None:
    if source.is_file():
        return
    folder = source.absolute().parent
    beside = [file.name for file in folder.iterdir()] if folder.is_dir() else []
    nearest = nearest_name(source.name, beside)
    raise AssetError(
        "there is no such file",
        key=f"--robot {source}",
        expected="a USD or URDF file",
        nearest=str(source.with_name(nearest)) if nearest else None,
    )


def _fill(draft: Path, name: str, source: Path | None) -> Survey:
    """Write all files of a project, and hold them against the checks that every task passes."""
    env = compose(["task=stand"]).config["env"]
    pose = env["robot"]["init_state"]["joint_pos"] if source is None else {}
    source = find_asset(env["robot"]["asset"]) if source is None else source
    robot = _surveyed(source, draft / "assets" / name, env, pose)
    asset = f"{name}/{source.name}"
    texts = {f"robot/{name}.yaml": robot_yaml(name, asset, robot), **config_files(name, robot)}
    write(draft, {f"configs/{file}": text for file, text in texts.items()})
    write(draft, project_files(name, asset, list(texts)))
    _require_valid(draft, name)
    return robot


def _surveyed(source: Path, folder: Path, env: Mapping[str, Any], pose: Mapping[str, float]) -> Survey:
    """Copy and survey a robot; an error speaks of the file that was given, not of the copy."""
    try:
        return survey(copy_robot(source, folder), env, pose)
    except AssetError as error:
        for part in ("message", "key", "where"):
            text = getattr(error, part)
            if text is not None:
                setattr(error, part, text.replace(str(folder), str(source.parent)))
        raise


def _require_valid(draft: Path, name: str) -> None:
    """Raise what `wheelleg check` finds in the draft: a robot that the program cannot use makes no project."""
    try:
        _, mistakes = find_mistakes([f"task={name}"], config_dirs=[draft / projects.CONFIGS])
    finally:
        projects.forget(draft)
    if mistakes:
        raise_all(mistakes)
