"""Create a user's project: write a draft, check the draft, and move it to its place."""

from __future__ import annotations

import importlib.util
import json
import keyword
import math
import os
import re
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
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
from wheelleg_exp.lint.rule import at_most
from wheelleg_exp.paths import configs_dir, find_asset
from wheelleg_exp.project.robot_yaml import leg_gains, names, number, robot_yaml, wheel_gains
from wheelleg_exp.project.survey import Survey, survey

if TYPE_CHECKING:
    from pxr import Sdf, UsdUtils

_FORM = re.compile(r"[A-Za-z][A-Za-z0-9_]*[A-Za-z0-9]")
_FALLBACK = "my_robot"
# A project cannot be named ``null`` or ``yes``, because YAML or Hydra reads such words as values.
_VALUES = {"null", "true", "false", "yes", "no", "on", "off", "inf", "nan"}
# A project cannot be named ``tests`` or ``build``, because projects, pytest, or pip use these names themselves.
_OWN = {"test", "tests", "configs", "assets", "runs", "build", "dist", "src", "conftest"}
_EXPECTED = "letters, digits, and underscores, starting with a letter, such as my_robot"


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
_PURPOSES = {
    "action": "the effect of one unit of action",
    "curriculum": "the weight of the penalty for leaving the place, after 100 iterations",
    "observation": "what the policy observes of the legs or of the travelled distance",
    "reward": "the weight of this project's own reward",
    "termination": "links that must not touch anything",
}


def project_files(name: str, asset: str, configs: Sequence[str]) -> dict[str, str]:
    """Return the text of each file of a new project by path, except the config files and the robot's files."""
    groups = {file: file.split("/")[0] for file in configs}
    rows = [f"| `configs/{file}` | {_PURPOSES[group]} |" for file, group in groups.items() if group in _PURPOSES]
    words = {"name": name, "asset": asset, "terms": "\n".join(rows)}
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
    """A new project at ``path``. ``accepted`` maps each lint rule that the task silences to the rule's message."""

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


def require_robot_file(source: Path) -> None:
    """Raise AssetError if the robot file of a new project does not exist."""
    if not source.is_file():
        folder = source.absolute().parent
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
        near = None if source.is_dir() else nearest_name(source.name, names)
        nearest = str(source.with_name(near)) if near else None
        message = "the path is a folder" if source.is_dir() else "there is no such file"
        raise AssetError(message, key=f"--robot {source}", expected="a USD or URDF file", nearest=nearest)


def create(place: Path, source: Path | None = None, *, allow_missing: bool = False) -> Created:
    """Create a project in the new folder ``place``; the folder's name is the name of the project.

    ``source`` is a USD or URDF file, by default that of the stock robot. ``allow_missing`` permits missing collider
    files. An invalid name, place, or robot file raises WheellegError, and the partly created project is removed.
    """
    path = require_place(place)
    name = path.name
    if source is not None:
        require_robot_file(source)
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
    write(draft, project_files(name, asset, list(texts)))
    try:
        _, mistakes = find_mistakes([f"task={name}"], config_dirs=[draft / projects.CONFIGS])
        if mistakes:
            raise_all(mistakes)
        # Silence each lint rule that reports a problem of the new task, and state the problem as the reason.
        found = examine(compose([f"task={name}"], config_dirs=[draft / projects.CONFIGS])).open
        loud = [finding.message for finding in found if finding.rule in _NEVER_SILENCED]
        robot.notes.extend(text for text in loud if text not in robot.notes)
        rules = dict.fromkeys(finding.rule for finding in found if finding.rule not in _NEVER_SILENCED)
        accepted = {rule: "; ".join(" ".join(f.message.split()) for f in found if f.rule == rule) for rule in rules}
        if accepted:
            task = draft / projects.CONFIGS / "task" / f"{name}.yaml"
            reasons = {rule: f"a property of this robot: {text}" for rule, text in accepted.items()}
            lines = "".join(f"    {rule}: {json.dumps(text, ensure_ascii=False)}\n" for rule, text in reasons.items())
            task.write_text(task.read_text(encoding="utf-8") + lines, encoding="utf-8")
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


_ENTITY = "_target_: wheelleg_exp.managers.SceneEntityCfg"
_CONTACT = 0.02  # A force above 2 % of the robot's weight counts as a contact.
_FORCE = 0.02  # The constant random force on the trunk is at most 2 % of the robot's weight.
_TORQUE = 0.01  # The constant random torque on the trunk is at most 1 % of the robot's weight times the robot's size.
_LOAD = (-0.05, 0.1)  # An event adds between -5 % and 10 % of the trunk's mass to the trunk.
_ERROR = 0.2  # A height error of 20 % of the robot's size costs a reward of 1 per second.
# The penalty is 0.15/s for a vertical speed of 0.1 sqrt(g h) or a tilt rate of 0.1 sqrt(g / h), with robot height h.
_COST = 0.15
_TILT = 0.03  # By default, the reset event tilts the robot randomly by at most 0.03 rad.
_DIP = 0.003  # A random start tilt may put a wheel into the ground by at most 0.3 % of the robot's size.
_STD = 0.5  # m/s and rad/s, largest
_AHEAD = 0.3  # An error of the travelled distance of 0.3 of the robot's size costs a reward of 1 per second.
# A heading error of 0.05 rad costs a reward of 1 per second.
_TURNED = 0.05
_EARLY = 0.1  # The penalty starts with 10 % of its weight, because a robot that cannot balance learns to fall early.
_EARLY_STEPS = 2400  # control steps: 100 iterations
_TRAVEL = 4.5  # The integrated distance error is at most 4.5 times the robot's size; less lets a force push the robot.
_LEG_SCALE = (0.05, 0.25)  # An action of 1 rotates a leg joint by 0.05 to 0.25 rad.
_WHEEL_EFFORT = 0.25  # At standstill, a wheel action of 1 needs 25 % of the wheel's effort limit.


def config_files(name: str, robot: Survey) -> dict[str, str]:
    """Return the YAML texts of a task and its reward, action, observation, and termination terms, by config path."""
    files = {f"task/{name}.yaml": task_yaml(name, robot), f"reward/{name}_upright.yaml": _upright(name, robot)}
    if robot.legs:
        files[f"action/{name}_legs.yaml"] = f"""# Legs: position targets around the default pose.
{name}_legs:
  _target_: wheelleg_exp.mdp.actions.JointPositionAction
  joint_names: ${{env.robot.joint_sets.leg_actions}}
  scale: {number(_leg_scale(robot), 2)}    # rad per unit of action
  use_default_offset: true
"""
        endless = [joint for joint in robot.legs if robot.dofs[joint].range is None]
        clip = f"  clip: [-3.15, 3.15]    # rad: {endless[0]} has no limits\n" if endless else ""
        note = "Leg joints relative to their defaults, rad; a wheel's angle is unbounded and not useful for balance."
        files[f"observation/{name}_leg_pos.yaml"] = f"""# {note}
{name}_leg_pos:
  _target_: wheelleg_exp.mdp.observations.joint_pos_rel
  asset_cfg:
    {_ENTITY}
    name: robot
    joint_names: ${{env.robot.joint_sets.legs}}
{clip}"""
    if robot.wheels:
        files[f"action/{name}_wheels.yaml"] = f"""# Wheels: velocity targets.
{name}_wheels:
  _target_: wheelleg_exp.mdp.actions.JointVelocityAction
  joint_names: ${{env.robot.joint_sets.wheel_actions}}
  scale: {number(at_most(_wheel_scale(robot), 2))}    # rad/s per unit of action
"""
    if _rolls(robot):
        scale = number(2.0 / robot.size, 2)
        files[f"observation/{name}_travel.yaml"] = f"""# Distance and angle by which the robot is ahead of its command.
{name}_travel:
  _target_: wheelleg_exp.mdp.observations.travel_error
  command_name: base_velocity
  scale: [{scale}, 20.0]    # per m, per rad
"""
        files[f"curriculum/{name}_travel.yaml"] = f"""# A robot that balances must also stay in place.
{name}_travel:
  _target_: wheelleg_exp.mdp.curriculums.modify_reward_weight
  term_name: travel_error
  weight: {number(_travel_weight(robot), 2)}
  num_steps: {_EARLY_STEPS}    # control steps: 100 iterations
"""
    if robot.raised_bodies:
        files[f"termination/{name}_contact.yaml"] = f"""# A link that should not touch the ground touches something.
{name}_contact:
  _target_: wheelleg_exp.mdp.terminations.illegal_contact
  threshold: {_threshold(robot)}    # N, of a weight of {robot.facts.weight:.3g} N
  sensor_cfg:
    {_ENTITY}
    name: contact_forces
    body_names: {names(robot.raised_bodies, 6, 16)}
"""
    return files


def task_yaml(name: str, robot: Survey) -> str:
    """Return the text of ``task/<name>.yaml``, in which the robot learns to stand and stay in place."""
    legs, wheels, rolls = bool(robot.legs), bool(robot.wheels), _rolls(robot)
    actions = _chosen((f"{name}_legs", legs), (f"{name}_wheels", wheels))
    seen = _chosen(
        "base_ang_vel, projected_gravity, velocity_commands",
        (f"{name}_leg_pos", legs),
        "joint_vel_rel, last_action",
        (f"{name}_travel", rolls),
    )
    rewards = _chosen(
        f"alive, terminating, {name}_upright, base_height",
        ("lin_vel_z, ang_vel_xy, track_lin_vel_xy, track_ang_vel_z", robot.level),
        ("leg_joint_deviation", legs),
        "action_rate",
        ("wheel_air", wheels),
        ("travel_error", rolls),
    )
    ends = _chosen(
        "time_out", (f"{name}_contact", bool(robot.raised_bodies)), ("bad_orientation", robot.level), "non_finite_state"
    )
    limit = "  terminations:\n    bad_orientation: {limit_angle: 0.8}   # rad, of tilt from upright\n"
    ends_at = limit if robot.level else ""
    later = f"\n  - /curriculum@env.curriculum: [{name}_travel]" if rolls else ""
    integrated = "\n  - /command/wheeled@env.commands: [base_velocity]" if rolls else ""
    most = number(_TRAVEL * robot.size, 2)
    travel = f"""      max_travel_error: {most}          # m; farther than a constant force pushes the robot
      max_lin_acceleration: 0.6     # m/s²; of the command: a robot on two wheels must first roll back
      max_ang_acceleration: 3.0     # rad/s²; of the command
"""
    return f"""# @package _global_
# {name} learns to stand on flat ground. `wheelleg train task={name}`
defaults:
  - /robot: {name}
  - /scene: flat
  - /sim: parity
  - /command@env.commands: [base_velocity]{integrated}
  - /action@env.actions: [{actions}]
  - /observation@env.observations.policy.terms:
      [{seen}]
  - /observation@env.observations.critic.terms:
      [{seen}, base_lin_vel, joint_effort]
  - /event@env.events: [physics_material, add_base_mass, base_external_force_torque, reset_base, reset_robot_joints]
  - /reward@env.rewards:
      [{rewards}]
  - /termination@env.terminations: [{ends}]{later}
  - override /agent: quick
  - _self_

task:
  name: {name}    # names the folder below run.root

env:
  num_envs: 512            # environments simulated side by side
  episode_length_s: 5.0    # 250 control steps
  decimation: 4            # physics steps per control step: 50 Hz control
  sim:
    dt: 0.005              # s
  commands:
    base_velocity:         # standing: the command is always zero
      ranges: {{lin_vel_x: [0.0, 0.0], lin_vel_y: [0.0, 0.0], ang_vel_z: [0.0, 0.0]}}
{travel if rolls else ""}  observations:
    policy:
      concatenate_terms: true
      enable_corruption: false   # noise of the terms is off
      history_length: 1          # the present state is enough: nothing is noisy or delayed
      flatten_history_dim: true
    critic: {{concatenate_terms: true, enable_corruption: false, history_length: 1, flatten_history_dim: true}}
{_events(robot)}{_rewards(robot)}{ends_at}  scene:
    sensors:
      contact_forces: {{force_threshold: {_threshold(robot)}}}   # N

agent: {{max_iterations: 200}}   # about eight minutes on two cores; most robots stand after 110

check:
  silence:   # findings of `wheelleg check --physics` that this task accepts, each with its reason
    zero_width_range: joints start at their defaults, MuJoCo has no restitution, and the command of standing is zero
"""


def _chosen(*parts: str | tuple[str, bool]) -> str:
    return ", ".join(part if isinstance(part, str) else part[0] for part in parts if isinstance(part, str) or part[1])


def _threshold(robot: Survey) -> str:
    return number(_CONTACT * robot.facts.weight, 2)


def _events(robot: Survey) -> str:
    weight = robot.facts.weight
    low, high = (number(share * robot.trunk_mass, 2) for share in _LOAD)
    force, torque = number(_FORCE * weight, 2), number(_TORQUE * weight * robot.size, 2)
    # Reduce the reset event's random tilt if its default range would put a wheel or foot into the ground.
    anatomy = robot.anatomy
    # Without wheels, assume that each foot is half of the robot's size away from the robot's middle.
    arms = dict.fromkeys(("roll", "pitch"), anatomy.size / 2)
    if anatomy.forward is not None:
        along = [sum(a * b for a, b in zip(wheel.contact, anatomy.forward, strict=True)) for wheel in anatomy.standing]
        arms = {"roll": anatomy.support_width / 2, "pitch": max(map(abs, along), default=0.0)}
    dip = _DIP * anatomy.size
    most = {axis: math.floor(1e3 * dip / arm) / 1e3 for axis, arm in arms.items() if arm * _TILT > dip}
    ranges = ", ".join(f"{axis}: [-{tilt}, {tilt}]" for axis, tilt in most.items())
    tilts = f"    reset_base: {{pose_range: {{{ranges}}}}}    # rad: more puts a wheel or foot into the ground\n"
    return f"""  events:                  # the stock disturbances, sized for {robot.facts.mass:.3g} kg
    add_base_mass: {{mass_distribution_params: [{low}, {high}]}}    # kg
    base_external_force_torque:
      force_range: [-{force}, {force}]          # N
      torque_range: [-{torque}, {torque}]       # N·m
    physics_material: {{restitution_range: [0.0, 0.0]}}    # MuJoCo has none
    reset_robot_joints: {{velocity_range: [1.0, 1.0]}}     # a factor on defaults of 0
{tilts if ranges else ""}"""


def _rewards(robot: Survey) -> str:
    size = robot.size
    text = f"""  rewards:                 # per second, sized for a robot that is {size:.3g} m high
    base_height: {{weight: {number(-1.0 / (_ERROR * size) ** 2, 2)}}}    # an error of a fifth of the height costs 1/s
    action_rate: {{weight: {number(-0.4 / max(1, len(robot.legs) + len(robot.wheels)), 2)}}}
"""
    if robot.level:
        gravity, size, track = robot.facts.gravity, robot.size, robot.facts.track
        turning = min(_STD, 2 * _tolerance(robot) / track) if track else _STD
        text += f"""    lin_vel_z: {{weight: {number(-_COST / (0.01 * gravity * size), 2)}}}
    ang_vel_xy: {{weight: {number(-_COST * size / (0.01 * gravity), 2)}}}
    track_lin_vel_xy: {{weight: 2.0, std: {number(_tolerance(robot), 2)}}}   # m/s
    track_ang_vel_z: {{weight: 1.0, std: {number(turning, 2)}}}   # rad/s
"""
    if robot.legs:
        text += "    leg_joint_deviation: {weight: -0.5}\n"
    if robot.wheels:
        text += f"    wheel_air: {{threshold: {_threshold(robot)}}}    # N\n"
    if _rolls(robot):
        weight = number(_EARLY * _travel_weight(robot), 2)
        length = number(1.0 / (_TURNED * math.sqrt(-_travel_weight(robot))), 2)
        text += f"    travel_error: {{command_name: base_velocity, weight: {weight}, heading_length: {length}}}   # m\n"
    return text


def _travel_weight(robot: Survey) -> float:
    """Return the weight with which a distance error of 0.3 of the robot's size costs a reward of 1 per second."""
    return -1.0 / (_AHEAD * robot.size) ** 2


def _rolls(robot: Survey) -> bool:
    """Return whether the speeds of the wheels tell how far the robot travels along the x axis of its root link."""
    return robot.level and bool(robot.wheels) and robot.anatomy.forward is not None


def _tolerance(robot: Survey) -> float:
    """Return a drift speed that a standing robot should avoid, m/s: the speed at a wheel action of 1."""
    return min(_STD, _wheel_scale(robot) * robot.facts.wheel_radius) if robot.wheels else _STD


def _wheel_scale(robot: Survey) -> float:
    """Return the wheel speed (rad/s) for an action of 1, which needs 25 % of the effort limit at standstill."""
    gains = wheel_gains(robot)
    wanted = {name: _WHEEL_EFFORT * gains.effort[name] / gains.damping[name] for name in gains.velocity}
    return min(min(max(wanted[name], 0.1 * top), top) for name, top in gains.velocity.items())


def _leg_scale(robot: Survey) -> float:
    """Return the leg rotation for an action of 1, rad, within the torque and joint limits if possible."""
    gains, reach = leg_gains(robot), []
    for name in robot.legs:
        low, high = robot.dofs[name].range or (-math.inf, math.inf)
        reach += [robot.positions[name] - low, high - robot.positions[name], gains.effort[name] / gains.stiffness[name]]
    smallest, largest = _LEG_SCALE
    return min(largest, max(smallest, math.floor(100 * min(reach)) / 100 if min(reach) < largest else largest))


def _upright(name: str, robot: Survey) -> str:
    return f"""# Standing upright: this project's own term, in {name}/terms.py.
{name}_upright:
  _target_: {name}.terms.upright
  weight: 2.0
  std: 0.2    # rad, tilt that leaves 1/e of the reward
  up: [{", ".join(number(part) for part in robot.up)}]    # the root link's axis that should point up
"""
