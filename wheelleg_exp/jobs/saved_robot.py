"""Save the robot (MJCF, meshes, conversion report, networks) in the folder ``asset/`` of a run, and load it again."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from xml.etree import ElementTree

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.asset.conversion_report import Report
from wheelleg_exp.config.tree_lookup import at
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import read_bytes, read_text, write_json, write_text
from wheelleg_exp.run.file_inventory import is_inside
from wheelleg_exp.run.run_config import ROBOT, RobotIdentity, recorded_robot
from wheelleg_exp.run.run_directory import RunDirectory

MJCF, REPORT = "robot.xml", "report.json"
_FORBIDDEN_TAGS = {
    *("include", "model", "attach", "extension", "plugin"),
    *("replicate", "composite", "flexcomp", "hfield", "texture", "skin", "size"),
}
_FOLDERS = ("assetdir", "meshdir", "texturedir")


def save_robot(directory: RunDirectory, asset: CachedConversion, source: str, model_sha256: str) -> None:
    """Copy the converted robot into a run's folder ``asset/``, and write the sha256 of each of its source files."""
    directory.asset.mkdir(parents=True, exist_ok=True)
    for part in (*asset.meshes, *asset.extra_files):
        target = directory.asset / part.relative_to(asset.output.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(part, target)
    write_text(directory.asset / MJCF, asset.output.read_text(encoding="utf-8"))
    write_text(directory.asset / REPORT, asset.report.to_json())
    identity = RobotIdentity(source=source, sources=asset.sources, model_sha256=model_sha256)
    write_json(directory.path / ROBOT, asdict(identity))


def saved_mjcf(directory: RunDirectory) -> Path:
    """Return the robot's MJCF file; raise RunDirectoryError for an element that converted robots never have."""
    # An unknown MJCF element can make MuJoCo read arbitrary files, load libraries, or allocate any amount of memory.
    path = directory.asset / MJCF
    if not path.is_file():
        message = "the run directory contains no MJCF of the robot"
        raise RunDirectoryError(message, key=str(path), expected="the MJCF that it was trained on")
    try:
        elements = list(ElementTree.fromstring(read_bytes(path)).iter())
    except ElementTree.ParseError as error:
        raise RunDirectoryError(f"the file is not an MJCF: {error}", key=str(path)) from error
    for element in elements:
        if element.tag in _FORBIDDEN_TAGS:
            raise RunDirectoryError(f"the file contains <{element.tag}>, which converted robots lack", key=str(path))
        for name, value in element.items():
            if (name.startswith("file") or name in _FOLDERS) and not is_inside(value):
                message = f"the file names {value!r}, outside its folder"
                raise RunDirectoryError(message, key=str(path), expected="files in its folder")
    return path


def load_saved_robot(directory: RunDirectory) -> CachedConversion:
    """Load the converted robot that a run directory contains."""
    path = directory.asset / REPORT
    try:
        report = Report.from_json(read_text(path))
    except (ValueError, RecursionError) as error:
        raise RunDirectoryError(f"the file is not a conversion report: {error}", key=str(path)) from error
    sources = dict(recorded_robot(directory).sources)
    return CachedConversion(saved_mjcf(directory), report, sources, key="", fresh=False)


def require_same_robot(recorded: Mapping[str, object], tree: Mapping[str, object], rule: str) -> None:
    """Raise ConfigError if overrides replaced the run's robot; ``rule`` is the error message."""
    for key in ("asset", "base"):
        if at(tree, f"env.robot.{key}") != at(recorded, f"env.robot.{key}"):
            expected = "the run's own value; another robot needs a new run"
            raise ConfigError(rule, key=f"env.robot.{key}", expected=expected)
