"""Check whether the joints, bodies, and sensors that a config names exist in the robot and the scene."""

from __future__ import annotations

import inspect
import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.check_terms import import_target, term_nodes
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.constraints import Node
from wheelleg_exp.errors import AssetError, ConfigError, not_one_of
from wheelleg_exp.paths import cache_dir, find_asset
from wheelleg_exp.sim.names import match_names, order_errors, shared_errors, valueless_errors
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import INJECTED, TARGET, walk_nodes

ASSET_KEY = "env.robot.asset"


@dataclass(frozen=True)
class RobotNames:
    """The names of a robot's joints and bodies, in the order of a breadth-first search through the body tree."""

    joints: list[str]
    bodies: list[str]


def converted(env: Mapping[str, object], asset_roots: Sequence[Path]) -> Path:
    """Return the path of the robot's MJCF, converted if not cached; ConfigError for a missing or unusable file."""
    from wheelleg_exp.asset import convert_cached
    from wheelleg_exp.asset.conversion_cache import find_extra_files

    robot: Mapping[str, Any] = section_at(env, "robot")
    try:
        source = find_asset(robot["asset"], asset_roots, key=ASSET_KEY)
        extra_files, base = find_extra_files(env, asset_roots), robot.get("base", "auto")
        return convert_cached(source, base=base, cache_dir=cache_dir() / "assets", extra_files=extra_files).output
    except AssetError as error:
        keyed = error if str(error.key).startswith("env.") else error.of(ASSET_KEY)
        raise ConfigError(keyed.message, key=keyed.key, expected=keyed.expected, nearest=keyed.nearest) from error


def read_names(env: Mapping[str, object], asset_roots: Sequence[Path]) -> RobotNames:
    """Return the names of the joints and bodies of the robot in the config section ``env``."""
    return names_in_mjcf(converted(env, asset_roots))


def names_in_mjcf(file: Path) -> RobotNames:
    """Return the names of joints and bodies of the robot in a converted MJCF, breadth first."""
    world = ElementTree.parse(file).getroot().find("worldbody")
    roots = world.findall("body") if world is not None else []
    # A top-level body without child bodies and joints belongs to the scene, not to the robot.
    parts = ("body", "joint", "freejoint")
    queue = deque(body for body in roots if any(body.find(part) is not None for part in parts))
    joints: list[str] = []
    bodies: list[str] = []
    while queue:
        body = queue.popleft()
        bodies.append(body.get("name", ""))
        joints += [joint.get("name", "") for joint in body.findall("joint") if joint.get("type") != "free"]
        queue.extend(body.findall("body"))
    return RobotNames(joints, bodies)


ROBOT = "robot"
_KINDS = {"joint_names": "joint", "body_names": "body"}
# `_BY_JOINT` lists the parameters of action terms and actuators that can map joint-name expressions to values.
_BY_JOINT = {
    "actions": ("scale", "offset", "clip"),
    "actuators": ("stiffness", "damping", "effort_limit", "velocity_limit", "armature", "friction", "viscous_friction"),
}


@dataclass(frozen=True)
class Members:
    """The joint and body names of each entity of the scene, in the order of the simulation model; None if unknown."""

    joints: dict[str, list[str]]
    bodies: dict[str, list[str] | None]


def check_robot(config: Mapping[str, object], names: RobotNames) -> list[ConfigError]:
    """Return the mistakes in a config's joint and body expressions, including references to unknown scene entities."""
    robot, sensors = section_at(config, "env.robot"), at(config, "env.scene.sensors")
    order = robot.get("joint_order")
    errors = order_errors(order, names.joints) if isinstance(order, list) else []
    joints = list(order) if isinstance(order, list) and not errors else names.joints
    for name in ("joint_pos", "joint_vel"):
        values = at(robot, ("init_state", name))
        errors += _mapping(values, joints, f"env.robot.init_state.{name}") if isinstance(values, Mapping) else []
    errors += _actuators(robot.get("actuators"), joints)
    bodies: dict[str, list[str] | None] = {ROBOT: names.bodies, "terrain": []}
    for name, node in sensors.items() if isinstance(sensors, Mapping) else ():
        if node is None:
            continue
        own = node if isinstance(node, Mapping) else {}
        # A sensor's config contains `body_name` (its mounting body) or `body_names` (the bodies that it observes).
        word = "body_name" if "body_name" in own else "body_names"
        listed, key = own.get(word), f"env.scene.sensors.{name}.{word}"
        found, wrong = match_all(listed, names.bodies, key, "body") if listed is not None else (names.bodies, [])
        bodies[name] = found or None
        errors += wrong
    errors += _undriven(config, joints)
    from wheelleg_exp.managers.action_manager import ActionTerm, shared_action_errors

    claims = []
    for section, path, node in term_nodes(config):
        target = _target(node, path) if section == "actions" and isinstance(node, Mapping) else None
        if inspect.isclass(target) and issubclass(target, ActionTerm) and node.get("joint_names"):
            claims.append((path, target.drives, match_all(node["joint_names"], joints, "", "joint")[0]))
    errors += shared_action_errors(claims)
    members = Members({ROBOT: joints}, bodies)
    for section, path, node in term_nodes(config):
        if isinstance(node, Mapping):
            errors += _term(section, path, node, members)
    return errors


def match_all(expressions: Any, names: Sequence[str], key: str, what: str) -> tuple[list[str], list[ConfigError]]:
    """Return the joint or body ``names`` that match regular expressions, and errors such as a missing match."""
    listed = [expressions] if isinstance(expressions, str) else list(expressions)
    if not all(isinstance(expression, str) for expression in listed):
        return [], []  # If a regular expression is not a string, a separate type check reports this.
    errors = [error for expression in listed for error in _match_error([expression], names, key, what)]
    errors = errors or _match_error(listed, names, key, what)
    return ([], errors) if errors else (match_names(listed, names, key=key, what=what)[1], [])


def _match_error(expressions: list[str], names: Sequence[str], key: str, what: str) -> list[ConfigError]:
    try:
        match_names(expressions, names, key=key, what=what)
    except ConfigError as error:
        return [error]
    return []


def _actuators(groups: object, joints: list[str]) -> list[ConfigError]:
    from wheelleg_exp.sim.actuators.actuator_base import NEEDED, ONE_GROUP

    errors, claims = [], []
    for name, node in groups.items() if isinstance(groups, Mapping) else ():
        if not isinstance(node, Mapping) or "joint_names_expr" not in node:
            continue
        key = f"env.robot.actuators.{name}"
        found, wrong = match_all(node["joint_names_expr"], joints, f"{key}.joint_names_expr", "joint")
        wrong += _by_joint("actuators", key, node, found)
        errors += wrong or [e for n in NEEDED for e in valueless_errors(node.get(n), found, f"{key}.{n}")]
        claims.append((str(name), f"{key}.joint_names_expr", found))
    return errors + shared_errors(claims, ONE_GROUP)


def _undriven(config: Mapping[str, object], joints: list[str]) -> Iterator[ConfigError]:
    groups = at(config, "env.robot.actuators")
    if not isinstance(groups, Mapping):
        return  # If env.robot.actuators is not a mapping, another check reports this.
    nodes = [n for n in groups.values() if isinstance(n, Mapping)]
    matched = [match_all(n.get("joint_names_expr") or [], joints, "", "joint") for n in nodes]
    if not all(found for found, _ in matched):
        return  # If a regular expression matches no joint, another check reports this.
    driven = {joint for found, _ in matched for joint in found}
    for section, path, node in term_nodes(config):
        named = node.get("joint_names") if section == "actions" and isinstance(node, Mapping) else None
        idle = [j for j in match_all(named, joints, "", "joint")[0] if j not in driven] if named else []
        if idle:
            message = f"no actuator drives {', '.join(idle)}, so the action moves nothing there"
            expected = "joints of env.robot.actuators: " + (", ".join(j for j in joints if j in driven) or "none")
            yield ConfigError(message, key=f"{path}.joint_names", expected=expected)


def _by_joint(kind: str, path: str, node: Mapping[str, object], joints: list[str]) -> Iterator[ConfigError]:
    for name in _BY_JOINT[kind]:
        values = node.get(name)
        if isinstance(values, Mapping) and joints:
            yield from _mapping(values, joints, f"{path}.{name}")


def _mapping(values: Mapping[str, object], joints: list[str], path: str) -> list[ConfigError]:
    """Return the errors in a mapping from regular expressions for joint names to values."""
    keys = split_path(path)
    errors = [e for name in values for e in _match_error([str(name)], joints, dotted((*keys, str(name))), "joint")]
    return errors or _match_error([str(name) for name in values], joints, path, "joint")


def _term(section: str, path: str, node: Node, members: Members) -> Iterator[ConfigError]:
    from wheelleg_exp.managers.term_interface import SceneEntityCfg

    for inner, part in walk_nodes(node, path):
        if inner != path and TARGET not in part:
            continue
        target = _target(part, inner)
        if target is None:
            continue
        is_entity = inspect.isclass(target) and issubclass(target, SceneEntityCfg)
        member = part.get("name") if is_entity else ROBOT
        yield from _names(section, inner, part, target, str(member), members)


def _target(node: Mapping[str, object], path: str) -> Callable[..., object] | None:
    try:
        return import_target(str(node.get(TARGET)), path)
    except ConfigError:
        return None  # If a ``_target_`` cannot be imported, another check reports this.


def _names(
    section: str, path: str, node: Node, target: Callable[..., object], member: str, members: Members
) -> Iterator[ConfigError]:
    if member not in members.bodies:
        yield not_one_of(f"the scene has no robot or sensor '{member}'", member, members.bodies, key=f"{path}.name")
        return
    accepted = inspect.signature(target).parameters
    for name, kind in _KINDS.items():
        expressions = node.get(name)
        if expressions is None or name not in accepted or name in INJECTED:
            continue
        key = f"{path}.{name}"
        if kind == "joint" and member not in members.joints:
            yield ConfigError(f"'{member}' has no joints", key=key, expected="body_names only")
            continue
        known = members.joints[member] if kind == "joint" else members.bodies[member]
        if known is None:
            continue  # If a sensor's regular expression matches no body, another check reports this.
        found, wrong = match_all(expressions, known, key, kind)
        yield from wrong
        if section == "actions" and kind == "joint":
            yield from _by_joint("actions", path, node, found)
        if "preserve_order" in accepted and not node.get("preserve_order", False) and found:
            written = match_names(expressions, found, key=key, what=kind, preserve_order=True)[1]
            if written != found:
                message = f"the order of this list is ignored: the term sees {', '.join(found)}"
                expected = f"preserve_order: true for {', '.join(written)}, or the robot's order in the list"
                yield ConfigError(message, key=key, expected=expected)
