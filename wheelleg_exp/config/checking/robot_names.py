"""The names of a robot's joints and bodies, from its converted file."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import AssetError, ConfigError
from wheelleg_exp.paths import cache_dir, find_asset

ASSET_KEY = "env.robot.asset"


@dataclass(frozen=True)
class RobotNames:
    """Names of joints and bodies, breadth first, as the robot orders them when its config says nothing."""

    joints: list[str]
    bodies: list[str]


def converted(env: Mapping[str, Any], asset_roots: Sequence[Path]) -> Path:
    """Convert a robot, or take it from the cache, and return its MJCF.

    Args:
        env: the ``env`` section.
        asset_roots: folders of the user's own assets.

    Raises:
        ConfigError: the file is not there, or holds no robot.
    """
    from wheelleg_exp.asset import convert_cached
    from wheelleg_exp.asset.beside import find_beside

    robot = env["robot"]
    try:
        source = find_asset(robot["asset"], asset_roots, key=ASSET_KEY)
        beside, base = find_beside(env, asset_roots), robot.get("base", "auto")
        return convert_cached(source, base=base, cache_dir=cache_dir() / "assets", beside=beside).output
    except AssetError as error:
        told = error if str(error.key).startswith("env.") else error.of(ASSET_KEY)
        raise ConfigError(told.message, key=told.key, expected=told.expected, nearest=told.nearest) from error


def read_names(env: Mapping[str, Any], asset_roots: Sequence[Path]) -> RobotNames:
    """Return the names of a robot; see ``converted``."""
    return names_in_mjcf(converted(env, asset_roots))


def names_in_mjcf(file: Path) -> RobotNames:
    """Return the names of the moving tree in an MJCF that the converter wrote, breadth first."""
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
