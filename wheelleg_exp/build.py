"""Build the environment of a composed config: convert the robot, then make the environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion, convert_cached
from wheelleg_exp.asset.conversion_cache import find_extra_files
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import AssetError
from wheelleg_exp.paths import cache_dir, find_asset
from wheelleg_exp.sim.options import EnvOptions, engine_kind, read_env


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
    return ManagerBasedRLEnv(with_robot_file(read_env(config["env"]), asset_roots), mjcf, int(config["seed"]))


def with_robot_file(env: EnvOptions, asset_roots: Sequence[Path] = ()) -> EnvOptions:
    """Return the environment's options with the robot file's absolute path, if the engine reads this file."""
    if not engine_kind(env.sim.engine).reads_robot_file:
        return env
    usd = find_asset(env.robot.asset, asset_roots, key="env.robot.asset").resolve()
    return replace(env, robot=replace(env.robot, asset=str(usd)))
