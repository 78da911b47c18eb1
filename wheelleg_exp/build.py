"""Build the environment of a composed config: convert the robot, then make the environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion, convert_cached
from wheelleg_exp.asset.conversion_cache import find_extra_files
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import AssetError
from wheelleg_exp.paths import cache_dir, find_asset


def prepare_asset(
    config: Mapping[str, Any], asset_roots: Sequence[Path] = (), networks: Mapping[str, Path] | None = None
) -> CachedConversion:
    """Return the MJCF of a composed config's robot, converted from the robot file or read from the cache.

    ``networks`` maps relative paths to the files, such as actuator networks, that are copied next to the MJCF.
    """
    robot = config["env"]["robot"]
    source = find_asset(robot["asset"], asset_roots, key="env.robot.asset")
    extra_files = find_extra_files(config["env"], asset_roots) | dict(networks or {})
    try:
        return convert_cached(source, base=robot["base"], cache_dir=cache_dir() / "assets", extra_files=extra_files)
    except AssetError as error:
        raise error.of("env.robot.asset") from error


def build_env(config: Mapping[str, Any], asset_roots: Sequence[Path] = ()) -> ManagerBasedRLEnv:
    """Build the simulated environment that a composed config describes."""
    mjcf = prepare_asset(config, asset_roots).output
    return ManagerBasedRLEnv(with_robot_file(config["env"], asset_roots), mjcf, int(config["seed"]))


def with_robot_file(env: Mapping[str, Any], asset_roots: Sequence[Path] = ()) -> Mapping[str, Any]:
    """Return an ``env`` section with the absolute path of the robot file, if the engine ``physx`` reads this file."""
    if env["sim"]["engine"] != "physx":
        return env
    usd = find_asset(env["robot"]["asset"], asset_roots, key="env.robot.asset").resolve()
    return {**env, "robot": {**env["robot"], "asset": str(usd)}}
