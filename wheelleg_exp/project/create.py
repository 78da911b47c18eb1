"""Create a user's project: write a draft, check the draft, and move it to its place."""

from __future__ import annotations

import importlib.util
import json
import keyword
import os
import re
import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp import packages as projects
from wheelleg_exp.asset.convert_robot import is_urdf
from wheelleg_exp.asset.file_limits import LARGEST_FILE, LOOKS, MESHES, TEXTURES, bounded_memory
from wheelleg_exp.asset.urdf.mesh_files import Files
from wheelleg_exp.asset.urdf.urdf_document import open_document
from wheelleg_exp.asset.usd.usd_layers import open_layers
from wheelleg_exp.asset.usd.usd_stage import SUFFIXES, library
from wheelleg_exp.config.checking.find_mistakes import find_mistakes
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.errors import AssetError, WheellegError, named_as, nearest_name
from wheelleg_exp.files import for_people, temporary_folder
from wheelleg_exp.lint.physics_check import examine
from wheelleg_exp.paths import configs_dir, find_asset
from wheelleg_exp.project.robot_yaml import number, robot_yaml
from wheelleg_exp.project.survey import Survey, survey

if TYPE_CHECKING:
    from pxr import Sdf, UsdUtils

_FORM = re.compile(r"[A-Za-z][A-Za-z0-9_]*[A-Za-z0-9]")
_FALLBACK = "my_robot"
# A project cannot be named ``null`` or ``yes``, because YAML or Hydra reads such words as values.
_VALUES = {"null", "true", "false", "yes", "no", "on", "off", "inf", "nan"}
# A project cannot be named ``tests`` or ``build``, because projects, pytest, or pip use these names themselves.
_OWN = {"test", "tests", "configs", "assets", "runs", "build", "dist", "src", "conftest"}
_EXPECTED = "two or more letters, digits, or underscores, starting with a letter, such as my_robot"


class NameTaken(WheellegError):
    """A new project cannot have the given name or be in the given folder."""


def require_name(name: str) -> None:
    """Raise NameTaken, with a valid project name as suggestion, unless ``name`` is a valid project name."""
    problem = _problem(name)
    if problem is not None:
        raise NameTaken(problem, key=name or "NAME", expected=_EXPECTED, nearest=_nearest(name))


def _problem(name: str) -> str | None:
    if not _FORM.fullmatch(name) or keyword.iskeyword(name) or keyword.issoftkeyword(name):
        return "the name is not a valid name of a Python package"
    if name.lower() in _VALUES:
        return "is a value in YAML, not a name"
    if name.lower() in _OWN:
        return "is the name of another part of a project"
    stock = sorted(configs_dir().rglob(f"{name}.yaml"), key=lambda file: (file.parent.name != "task", file))
    if stock:  # Tasks come first.
        return f"is the name of a stock config, {stock[0].relative_to(configs_dir()).with_suffix('').as_posix()}"
    if name in sys.stdlib_module_names or importlib.util.find_spec(name) is not None:
        return "is the name of an installed Python package"
    return None


def _nearest(name: str) -> str:
    plain = re.sub(r"[^A-Za-z0-9]+", "_", Path(name).name).strip("_") or _FALLBACK
    plain = plain if plain[0].isalpha() else f"robot_{plain}"
    options = chain([plain, f"{plain}_robot", f"my_{plain}"], (f"my_{plain}{number}" for number in count(2)))
    return next(option for option in options if _problem(option) is None)


_TEMPLATES = {
    "pyproject.toml": "pyproject.toml.txt",
    ".gitignore": "gitignore.txt",
    "README.md": "README.md.txt",
    "{{name}}/__init__.py": "init.py.txt",
    "{{name}}/terms.py": "terms.py.txt",
    "tests/test_{{name}}.py": "test.py.txt",
}
_NEVER_SILENCED = ("missing_files", "robot_size")  # Lint rules about errors of the robot file are never silenced.


def project_files(name: str, asset: str) -> dict[str, str]:
    """Return the text of each file of a new project by path, except the config files and the robot's files."""
    words = {"name": name, "asset": asset}
    folder = resources.files("wheelleg_exp.project") / "templates"
    texts = {file: (folder / template).read_text(encoding="utf-8") for file, template in _TEMPLATES.items()}
    return {_filled(file, words): _filled(text, words) for file, text in texts.items()}


def _filled(text: str, words: Mapping[str, str]) -> str:
    for key, value in words.items():
        text = text.replace("{{" + key + "}}", value)
    return text


def write(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files below a folder; ``texts`` maps each relative path to the file's text."""
    for file, text in texts.items():
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


@dataclass(frozen=True)
class Created:
    """A new project at ``path``. ``accepted`` maps each lint rule that the robot silences to the rule's message."""

    path: Path
    files: list[Path]
    robot: Survey
    accepted: dict[str, str]


def require_place(place: Path) -> Path:
    """Return the absolute path of a new project; raise NameTaken if no project can be created there."""
    path = Path(place).expanduser().absolute()
    require_name(path.name)
    _require_free(path)
    if not path.parent.is_dir():
        raise NameTaken("the parent folder of the new project does not exist", key=str(path.parent))
    home = configs_dir().parent
    if (home / projects.FILE).is_file() and path.resolve().is_relative_to(home.resolve()):
        beside = Path(os.path.relpath(home.parent / path.name))
        message = "a project cannot be inside the package wheelleg_exp itself"
        raise NameTaken(message, key=str(path), nearest=str(beside))
    return path


def robot_file(source: Path) -> Path:
    """Return the robot file of a new project: an existing file, or that of a name of the package robot_descriptions."""
    named = len(source.parts) == 1 and not source.suffix and not source.exists()
    if named and importlib.util.find_spec("robot_descriptions") is not None:
        return _described(source.name)
    if not source.is_file():
        folder = source.absolute().parent
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
        near = None if source.is_dir() else nearest_name(source.name, names)
        nearest = str(source.with_name(near)) if near else None
        message = "the path is a folder" if source.is_dir() else "there is no such file"
        package = ", or a name of the package robot_descriptions (pip install robot_descriptions)" if named else ""
        raise AssetError(message, key=f"--robot {source}", expected=f"a USD or URDF file{package}", nearest=nearest)
    return source


def _described(name: str) -> Path:
    """Return the URDF file of a robot description; the import of its module downloads the robot with git."""
    key, known = f"--robot {name}", importlib.import_module("robot_descriptions").DESCRIPTIONS
    if name not in known or not known[name].has_urdf:
        message = (
            "this robot description has no URDF" if name in known else "there is no such file or robot description"
        )
        near = nearest_name(name, [other for other in known if known[other].has_urdf])
        raise AssetError(message, key=key, expected="a USD or URDF file, or a description with a URDF", nearest=near)
    try:
        return Path(importlib.import_module(f"robot_descriptions.{name}").URDF_PATH)
    except Exception as error:
        raise AssetError(f"the package robot_descriptions cannot load this robot: {error}", key=key) from error


def create(place: Path, source: Path | None = None, *, allow_missing: bool = False) -> Created:
    """Create a project in the new folder ``place``; the folder's name is the name of the project.

    ``source`` is a USD or URDF file, or a name of the package robot_descriptions, by default the file of the stock
    robot. ``allow_missing`` permits missing collider files. An invalid name, place, or robot file raises WheellegError,
    and the partly created project is removed.
    """
    path = require_place(place)
    name = path.name
    if source is not None:
        source = robot_file(source)
    # First write the project to a temporary folder, so that an error leaves no incomplete project.
    with for_people(path), temporary_folder(path) as scratch:
        draft = scratch / name
        draft.mkdir()
        robot, accepted = _fill(draft, name, source, allow_missing)
        files = sorted(file.relative_to(draft) for file in draft.rglob("*") if file.is_file())
        _require_free(path)
        draft.rename(path)
    return Created(path, files, robot, accepted)


def _require_free(path: Path) -> None:
    if os.path.lexists(path):
        message = "the project folder exists already, and no file is overwritten"
        raise NameTaken(message, key=str(path), expected="a new name")


def _fill(draft: Path, name: str, source: Path | None, allow_missing: bool) -> tuple[Survey, dict[str, str]]:
    env = compose(["task=stand"]).config["env"]
    pose = env["robot"]["init_state"]["joint_pos"] if source is None else {}
    source = find_asset(env["robot"]["asset"]) if source is None else source
    # Copy the user's robot file and measure the robot; error messages name the original file, not the copy.
    folder = draft / "assets" / name
    with named_as(folder, source.parent):
        robot = survey(copy_robot(source, folder), env, pose, allow_missing=allow_missing)
    asset = f"{name}/{source.name}"
    texts = {f"robot/{name}.yaml": robot_yaml(name, asset, robot), **config_files(name, robot)}
    write(draft, {f"configs/{file}": text for file, text in texts.items()})
    write(draft, project_files(name, asset))
    try:
        _, mistakes = find_mistakes([f"task={name}"], config_dirs=[draft / projects.CONFIGS])
        if mistakes:
            raise_all(mistakes)
        # Silence each lint rule that reports a problem of the robot, and state the problem as the reason.
        tasks = ([f"task={name}"], ["task=walk", f"robot={name}", "realism=full"])
        found = [f for task in tasks for f in examine(compose(task, config_dirs=[draft / projects.CONFIGS])).open]
        loud = [finding.message for finding in found if finding.rule in _NEVER_SILENCED]
        robot.notes.extend(text for text in loud if text not in robot.notes)
        rules = dict.fromkeys(finding.rule for finding in found if finding.rule not in _NEVER_SILENCED)
        said = {rule: dict.fromkeys(" ".join(f.message.split()) for f in found if f.rule == rule) for rule in rules}
        accepted = {rule: "; ".join(messages) for rule, messages in said.items()}
        if accepted:
            file = draft / projects.CONFIGS / "robot" / f"{name}.yaml"
            lines = "".join(f"  {rule}: {json.dumps(text, ensure_ascii=False)}\n" for rule, text in accepted.items())
            head = "silence:    # findings of `wheelleg check --physics` that are properties of this robot\n"
            file.write_text(file.read_text(encoding="utf-8") + head + lines, encoding="utf-8")
    finally:
        projects.forget(draft)
    return robot, accepted


def copy_robot(source: Path, folder: Path) -> Path:
    """Copy a robot file, and every layer, texture, or mesh to which the file refers, to ``folder``.

    Copied files keep their paths relative to the robot file. Files from outside the robot file's folder get new paths,
    which the copied robot file then names. ``copy_robot`` returns the path of the copied robot file.
    """
    folder.mkdir(parents=True)
    return _copy_urdf(source, folder) if is_urdf(source, {}) else _copy_usd(source, folder)


def _copy_usd(source: Path, folder: Path) -> Path:
    from pxr import UsdUtils

    with library(source), bounded_memory(source):
        chosen = _usd_filter(source)
        layers, assets, _ = UsdUtils.ComputeAllDependencies(str(source.resolve()), chosen)
        files = {Path(layer.realPath.split("[")[0]) for layer in layers if layer.realPath}
        files |= {Path(asset.split("[")[0]) for asset in assets}
        files = {file.resolve() for file in files if file.is_file()}
        home = source.resolve().parent
        if all(file.is_relative_to(home) for file in files):
            for file in {source.resolve(), *files}:
                _copy(file, folder / file.relative_to(home))
            if source.name != source.resolve().name:  # Copy the robot file also under the name of its symbolic link.
                _copy(source, folder / source.name)
            return folder / source.name
        # The USD library copies files from outside the robot's folder, and updates their paths in the copies.
        done = UsdUtils.LocalizeAsset(str(source.resolve()), str(folder), False, chosen)
        if not done or not (folder / source.name).is_file():
            message, expected = "the robot's layers cannot be copied", "a file whose layers lie in its own folder"
            raise AssetError(message, where=str(source), expected=expected)
    return folder / source.name


def _usd_filter(source: Path) -> Callable[[Sdf.Layer, UsdUtils.DependencyInfo], UsdUtils.DependencyInfo]:
    """Return a filter with which the USD library copies only the layers, textures, and materials of a robot.

    Without a filter, a project would contain a copy of any file that a robot file names, such as ``/etc/passwd``.
    """
    from pxr import UsdUtils

    found: dict[str, Sdf.Layer] = {}
    todo = open_layers(source)
    while todo:
        item = todo.pop()
        if item.identifier not in found:
            found[item.identifier] = item
            paths = {Path(item.ComputeAbsolutePath(name)) for name in _asset_paths(item)}
            for path in sorted(paths):
                if str(path) not in found and path.suffix.lower() in SUFFIXES and path.exists():
                    todo += open_layers(path)
    layers = {layer.realPath for layer in list(found.values())}

    def choose(layer: Sdf.Layer, named: UsdUtils.DependencyInfo) -> UsdUtils.DependencyInfo:
        names = [layer.ComputeAbsolutePath(name) for name in (named.assetPath, *named.dependencies)]
        files = [Path(name) for name in names if name not in layers]
        # A name can be a pattern that matches several textures or materials.
        small = [not file.exists() or (file.is_file() and file.stat().st_size <= LARGEST_FILE) for file in files]
        looks = all(file.suffix.lower() in LOOKS for file in files)
        return named if looks and all(small) else UsdUtils.DependencyInfo()

    return choose


def _asset_paths(layer: Sdf.Layer) -> set[str]:
    from pxr import Sdf, UsdUtils

    found: set[str] = set()

    def note(name: str) -> str:
        found.add(name)
        return name

    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    UsdUtils.ModifyAssetPaths(copy, note)
    return found


def _copy(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, to)


def _copy_urdf(source: Path, folder: Path) -> Path:
    document = open_document(source)
    files = Files(document)
    elements = [element for element in document.root.walk() if element.tag in ("mesh", "texture")]
    names = {name for element in elements if (name := element.attributes.get("filename"))}
    paths = {name: files.find(name, (*MESHES, *TEXTURES)) for name in sorted(names)}
    found = {name: path.resolve() for name, path in paths.items() if path is not None}
    # The copied URDF keeps the relative paths of the files that are below its folder.
    kept, text = {}, source.read_bytes()
    for name, path in found.items():
        plain = Path(os.path.normpath(name))
        beside = source.resolve().parent / plain
        is_below = not plain.is_absolute() and plain.parts[0] != ".." and ":" not in name and "\\" not in name
        if is_below and beside.is_file() and beside.resolve() == path:
            kept[name] = plain.as_posix()
    taken = {found[name]: place for name, place in kept.items()}
    for name, path in found.items():
        place = kept.get(name)
        if place is None:
            place = taken.setdefault(path, _free(f"meshes/{path.name}", taken))
            text = _renamed(text, name, place)
        _copy(path, folder / place)
    copy = folder / source.name
    copy.write_bytes(text)
    return copy


def _free(name: str, taken: dict[Path, str]) -> str:
    used = {place.lower() for place in taken.values()}
    path, number = Path(name), 2
    while name.lower() in used:
        name, number = path.with_stem(f"{path.stem}_{number}").as_posix(), number + 1
    return name


def _renamed(text: bytes, name: str, place: str) -> bytes:
    from xml.sax.saxutils import escape

    written = {escape(name), name}
    for form in written:
        quoted = re.compile(rb"(filename\s*=\s*)([\"'])" + re.escape(form.encode()) + rb"\2")
        text = quoted.sub(lambda match: match.group(1) + b'"' + escape(place).encode() + b'"', text)
    return text


# The terms of `article` that need a root link whose z axis points up; only robots with such a link roll.
_OF_LEVEL = ("lin_vel_z", "ang_vel_xy", "pitch_orientation")


def config_files(name: str, robot: Survey) -> dict[str, str]:
    """Return the YAML texts of a task, in which the robot stands, and of the project's own reward, by config path."""
    rolls = robot.level and bool(robot.wheels) and robot.anatomy.forward is not None
    stock = "stand" if rolls else "article"  # the only stock task without the travelled distance
    removed = "".join(f"    {term}: null\n" for term in _OF_LEVEL)
    changes = "" if robot.level else f"env:\n  rewards:    # without those that need a level root link\n{removed}\n"
    task = f"""# @package _global_
# {name} learns to stand on flat ground: `{stock}` with the reward of this project. `wheelleg train task={name}`
defaults:
  - /task/{stock}
  - /reward@env.rewards: [{name}_upright]
  - override /robot: {name}
  - override /agent: quick
  - _self_

task: {{name: {name}}}    # names the folder below run.root

{changes}agent: {{max_iterations: 200}}
"""
    reward = f"""# Standing upright: this project's own term, in {name}/terms.py.
{name}_upright:
  _target_: {name}.terms.upright
  weight: 2.0
  std: 0.2    # rad, tilt that leaves 1/e of the reward
  up: [{", ".join(number(part) for part in robot.up)}]    # the root link's axis that should point up
"""
    return {f"task/{name}.yaml": task, f"reward/{name}_upright.yaml": reward}
