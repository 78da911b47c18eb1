"""Check the names of joints, bodies, sensors, and terms in a config against the robot and the config itself."""

from __future__ import annotations

import inspect
import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.check_terms import import_target, term_nodes
from wheelleg_exp.errors import AssetError, ConfigError, nearest_name
from wheelleg_exp.paths import cache_dir, find_asset
from wheelleg_exp.sim.names import match_names, order_errors, shared_errors, valueless_errors
from wheelleg_exp.terms.key_syntax import dotted, split_path
from wheelleg_exp.terms.term_binding import INJECTED, TARGET, walk_nodes

ASSET_KEY = "env.robot.asset"


@dataclass(frozen=True)
class RobotNames:
    """Names of joints and bodies, breadth first: the robot's default order."""

    joints: list[str]
    bodies: list[str]


def converted(env: Mapping[str, Any], asset_roots: Sequence[Path]) -> Path:
    """Convert a robot, or take it from the cache, and return its MJCF.

    Args:
        env: the ``env`` section.
        asset_roots: folders of the user's assets.

    Raises:
        ConfigError: the file is missing, or does not contain a robot.
    """
    from wheelleg_exp.asset import convert_cached
    from wheelleg_exp.asset.conversion_cache import find_beside

    robot = env["robot"]
    try:
        source = find_asset(robot["asset"], asset_roots, key=ASSET_KEY)
        beside, base = find_beside(env, asset_roots), robot.get("base", "auto")
        return convert_cached(source, base=base, cache_dir=cache_dir() / "assets", beside=beside).output
    except AssetError as error:
        keyed = error if str(error.key).startswith("env.") else error.of(ASSET_KEY)
        raise ConfigError(keyed.message, key=keyed.key, expected=keyed.expected, nearest=keyed.nearest) from error


def read_names(env: Mapping[str, Any], asset_roots: Sequence[Path]) -> RobotNames:
    """Return the names of a robot; see ``converted``."""
    return names_in_mjcf(converted(env, asset_roots))


def names_in_mjcf(file: Path) -> RobotNames:
    """Return the names of joints and bodies in the robot's tree of a converted MJCF, breadth first."""
    world = ElementTree.parse(file).getroot().find("worldbody")
    roots = world.findall("body") if world is not None else []
    queue = deque(body for body in roots if body.find("body") is not None or _joints(body) or _is_free(body))
    joints: list[str] = []
    bodies: list[str] = []
    while queue:
        body = queue.popleft()
        bodies.append(body.get("name", ""))
        joints += _joints(body)
        queue.extend(body.findall("body"))
    return RobotNames(joints, bodies)


def _joints(body: ElementTree.Element) -> list[str]:
    return [joint.get("name", "") for joint in body.findall("joint") if joint.get("type") != "free"]


def _is_free(body: ElementTree.Element) -> bool:
    return body.find("freejoint") is not None or any(j.get("type") == "free" for j in body.findall("joint"))


ROBOT = "robot"
_KINDS = {"joint_names": "joint", "body_names": "body"}
# Values by joint expression, of action terms and of actuators.
_BY_JOINT = {
    "actions": ("scale", "offset", "clip"),
    "actuators": ("stiffness", "damping", "effort_limit", "velocity_limit", "armature"),
}


@dataclass(frozen=True)
class Members:
    """The names of joints and bodies of each member of the scene, in the member's order; None if unknown."""

    joints: dict[str, list[str]]
    bodies: dict[str, list[str] | None]


def check_robot(config: Mapping[str, Any], names: RobotNames) -> list[ConfigError]:
    """Return the mistakes in every joint and body expression, and every name that is not a member of the scene.

    Args:
        config: the composed tree.
        names: the robot's names, breadth first.
    """
    robot, sensors = config["env"]["robot"], config["env"]["scene"].get("sensors")
    joints, errors = _joint_order(robot.get("joint_order"), names.joints)
    errors += _initial_state(robot.get("init_state"), joints) + _actuators(robot.get("actuators"), joints)
    bodies: dict[str, list[str] | None] = {ROBOT: names.bodies, "terrain": []}
    for name, node in sensors.items() if isinstance(sensors, Mapping) else ():
        if node is None:
            continue
        own = node if isinstance(node, Mapping) else {}
        word = "body_name" if "body_name" in own else "body_names"  # a sensor is mounted on one body, or senses several
        listed, key = own.get(word), f"env.scene.sensors.{name}.{word}"
        found, wrong = match_all(listed, names.bodies, key, "body") if listed is not None else (names.bodies, [])
        bodies[name] = found or None
        errors += wrong
    errors += _undriven(config, joints) + _shared_actions(config, joints)
    members = Members({ROBOT: joints}, bodies)
    for section, path, node in term_nodes(config):
        if isinstance(node, Mapping):
            errors += _term(section, path, node, members)
    return errors


def match_all(expressions: Any, names: Sequence[str], key: str, what: str) -> tuple[list[str], list[ConfigError]]:
    """Return the names that expressions match, in their own order, and each mistake in the expressions."""
    listed = [expressions] if isinstance(expressions, str) else list(expressions)
    if not all(isinstance(expression, str) for expression in listed):
        return [], []  # the check of types reports it
    errors = [error for expression in listed for error in _match_error([expression], names, key, what)]
    errors = errors or _match_error(listed, names, key, what)
    if errors:
        return [], errors
    return match_names(listed, names, key=key, what=what)[1], []


def _match_error(expressions: list[str], names: Sequence[str], key: str, what: str) -> list[ConfigError]:
    try:
        match_names(expressions, names, key=key, what=what)
    except ConfigError as error:
        return [error]
    return []


def _joint_order(order: Any, joints: list[str]) -> tuple[list[str], list[ConfigError]]:
    """Return the joints in the robot's order, and the mistakes in the config's ``joint_order``."""
    if not isinstance(order, list):
        return joints, []
    errors = order_errors(order, joints)
    return (joints if errors else list(order)), errors


def _initial_state(state: Any, joints: list[str]) -> list[ConfigError]:
    errors = []
    for name in ("joint_pos", "joint_vel"):
        values = state.get(name) if isinstance(state, Mapping) else None
        if isinstance(values, Mapping):
            errors += _mapping(values, joints, f"env.robot.init_state.{name}")
    return errors


def _actuators(groups: Any, joints: list[str]) -> list[ConfigError]:
    from wheelleg_exp.sim.actuators import NEEDED, ONE_GROUP

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


def _shared_actions(config: Mapping[str, Any], joints: list[str]) -> list[ConfigError]:
    """Find joints for which two action terms set the same kind of target. Only the later term would have an effect."""
    from wheelleg_exp.managers.action_manager import ActionTerm, shared_action_errors

    claims = []
    for section, path, node in term_nodes(config):
        target = _target(node, path) if section == "actions" and isinstance(node, Mapping) else None
        if inspect.isclass(target) and issubclass(target, ActionTerm) and node.get("joint_names"):
            found = match_all(node["joint_names"], joints, "", "joint")[0]
            claims.append((path, target.drives, found))
    return shared_action_errors(claims)


def _undriven(config: Mapping[str, Any], joints: list[str]) -> list[ConfigError]:
    """Find actions on joints that no actuator drives. They would have no effect."""
    groups = config["env"]["robot"].get("actuators")
    if not isinstance(groups, Mapping):
        return []  # the check of env.robot reports it
    nodes = [n for n in groups.values() if isinstance(n, Mapping)]
    matched = [match_all(n.get("joint_names_expr") or [], joints, "", "joint") for n in nodes]
    if not all(found for found, _ in matched):
        return []  # one expression is wrong and reported, so the driven joints are unknown
    driven = {joint for found, _ in matched for joint in found}
    errors = []
    for section, path, node in term_nodes(config):
        named = node.get("joint_names") if section == "actions" and isinstance(node, Mapping) else None
        idle = [j for j in match_all(named, joints, "", "joint")[0] if j not in driven] if named else []
        if idle:
            message = f"no actuator drives {', '.join(idle)}, so the action moves nothing there"
            expected = "joints of env.robot.actuators: " + (", ".join(j for j in joints if j in driven) or "none")
            errors.append(ConfigError(message, key=f"{path}.joint_names", expected=expected))
    return errors


def _by_joint(kind: str, path: str, node: Mapping[str, Any], joints: list[str]) -> list[ConfigError]:
    errors = []
    for name in _BY_JOINT[kind]:
        if isinstance(node.get(name), Mapping) and joints:
            errors += _mapping(node[name], joints, f"{path}.{name}")
    return errors


def _mapping(values: Mapping[str, Any], joints: list[str], path: str) -> list[ConfigError]:
    """Return the mistakes in a mapping by joint expression, each with its own key."""
    keys = split_path(path)
    errors = [e for name in values for e in _match_error([str(name)], joints, dotted((*keys, str(name))), "joint")]
    return errors or _match_error([str(name) for name in values], joints, path, "joint")


def _term(section: str, path: str, node: Mapping[str, Any], members: Members) -> list[ConfigError]:
    errors = []
    for inner, part in walk_nodes(node, path):
        if inner != path and TARGET not in part:
            continue
        target = _target(part, inner)
        if target is None:
            continue
        member = part.get("name") if _is_entity(target) else ROBOT
        errors += _names(section, inner, part, target, str(member), members)
    return errors


def _target(node: Mapping[str, Any], path: str) -> Callable[..., Any] | None:
    try:
        return import_target(str(node.get(TARGET)), path)
    except ConfigError:
        return None  # the check of terms reports it


def _is_entity(target: Callable[..., Any]) -> bool:
    from wheelleg_exp.managers import SceneEntityCfg

    return inspect.isclass(target) and issubclass(target, SceneEntityCfg)


def _names(
    section: str, path: str, node: Mapping[str, Any], target: Callable[..., Any], member: str, members: Members
) -> list[ConfigError]:
    if member not in members.bodies:
        scene = list(members.bodies)
        message, nearest = f"the scene has no '{member}'", nearest_name(member, scene)
        return [ConfigError(message, key=f"{path}.name", expected="one of " + ", ".join(scene), nearest=nearest)]
    accepted = inspect.signature(target).parameters
    errors = []
    for name, kind in _KINDS.items():
        expressions = node.get(name)
        if expressions is None or name not in accepted or name in INJECTED:
            continue
        key = f"{path}.{name}"
        if kind == "joint" and member not in members.joints:
            errors.append(ConfigError(f"'{member}' has no joints", key=key, expected="body_names only"))
            continue
        known = members.joints[member] if kind == "joint" else members.bodies[member]
        if known is None:
            continue  # the member's own mistake is reported
        found, wrong = match_all(expressions, known, key, kind)
        errors += wrong
        if section == "actions" and kind == "joint":
            errors += _by_joint("actions", path, node, found)
        if "preserve_order" in accepted and not node.get("preserve_order", False) and found:
            errors += _order(expressions, found, key, kind)
    return errors


def _order(expressions: Any, found: list[str], key: str, what: str) -> list[ConfigError]:
    """Reject a list of names whose order would be ignored."""
    written = match_names(expressions, found, key=key, what=what, preserve_order=True)[1]
    if written == found:
        return []
    return [
        ConfigError(
            f"the order of this list is ignored: the term sees {', '.join(found)}",
            key=key,
            expected=f"preserve_order: true for {', '.join(written)}, or the robot's order in the list",
        )
    ]
