"""The interpolation ``${sized:VALUE,UNIT}``: a number of the stock robot, converted for the size of the config's robot.

Robots of different sizes that are similar move alike if lengths, speeds, and masses have equal ratios to the robot's
own (dynamic similarity; Froude scaling): gravity is the same for all, so a force is a share of the weight.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TypeGuard

from omegaconf import DictConfig, ListConfig, OmegaConf

from wheelleg_exp.config.tree_lookup import section_at

# The keys of ``env.robot`` that give a robot's size, with the stock robot's numbers. A robot file without ``size`` is
# from an earlier version, in which the tasks of a project contain the robot's own numbers.
SIZES = {
    "size": 0.07,
    "mass": 0.5,
    "natural_speed": 0.83,
    "standing_height": 0.07,
    "wheel_radius": 0.02,
    "leg_reach": 0.667,
}
# Each unit as powers of these keys. ``height`` and ``wheel`` are lengths in metres that grow with the standing height
# and with the radius of the wheels; ``leg`` is a rotation of a leg joint in rad. ``vx`` and ``wz`` are shares of the
# largest forward speed and yaw rate that an evaluated run's task commands.
_UNITS: Mapping[str, Mapping[str, int]] = {
    "m": {"size": 1},
    "s": {"size": 1, "natural_speed": -1},
    "kg": {"mass": 1},
    "N": {"mass": 1},
    "Nm": {"mass": 1, "size": 1},
    "rad": {},
    "height": {"standing_height": 1},
    "wheel": {"wheel_radius": 1},
    "leg": {"leg_reach": 1},
    "vx": {"lin_vel_x": 1},
    "wz": {"ang_vel_z": 1},
}
_RANGES = "commands.base_velocity.ranges"  # of which ``vx`` and ``wz`` are shares
_LACKING = {"leg_reach": "leg joints", "wheel_radius": "wheels"}
_FACTOR = re.compile(r"(?P<unit>[A-Za-z]+)(?P<power>[1-9]?)|1")
_DIGITS = 6  # significant digits of a converted number


def sized(value: object, unit: str, *, _root_: DictConfig) -> object:
    """Return ``value``, a number or nested lists of numbers in ``unit`` such as ``m/s`` or ``1/m2``, for the robot.

    Raise ValueError for an unknown unit, or if the unit needs legs, wheels, or commanded speeds that are missing.
    """
    factor, powers = 1.0, _powers(str(unit))
    if OmegaConf.select(_root_, "env.robot.size") is None:
        powers = {k: n for k, n in powers.items() if k not in SIZES and OmegaConf.select(_root_, f"env.robot.{k}")}
    for key, power in powers.items():
        size = OmegaConf.select(_root_, f"env.robot.{key}")
        if not _is_size(size) and key not in SIZES:
            raise ValueError(f"the task commands no speed in env.{_RANGES}.{key}, but a number in '{unit}' needs it")
        if not _is_size(size):
            lack = f"the robot has no {_LACKING[key]}: " if key in _LACKING else ""
            raise ValueError(f"{lack}env.robot.{key} is {size}, but a number in '{unit}' needs it")
        factor *= (size / SIZES.get(key, 1.0)) ** power
    return _times(value, factor)


def _is_size(size: object) -> TypeGuard[float]:
    return isinstance(size, (int, float)) and 0 < size < math.inf


def _powers(unit: str) -> dict[str, int]:
    powers: dict[str, int] = {}
    for sign, part in zip((1, -1), unit.split("/"), strict=False):
        for text in part.split("*"):
            found = _FACTOR.fullmatch(text)
            if found is None or unit.count("/") > 1 or (found["unit"] or "rad") not in _UNITS:
                raise ValueError(f"'{unit}' is not a unit of ${{sized:…}}; units are {', '.join(_UNITS)}, as in 1/m2")
            for key, power in _UNITS[found["unit"] or "rad"].items():
                powers[key] = powers.get(key, 0) + sign * power * int(found["power"] or 1)
    return powers


def _times(value: object, factor: float) -> object:
    if isinstance(value, (list, ListConfig)):
        return ListConfig([_times(item, factor) for item in value])
    if not isinstance(value, (int, float)):
        raise ValueError(f"'{value}' is not a number")
    return value if factor == 1.0 else float(f"{value * factor:.{_DIGITS}g}")


def robot_sizes(env: Mapping[str, object]) -> list[str]:
    """Return overrides for a config without a robot: the sizes and the largest commands of the config ``env``."""
    robot, ranges = section_at(env, "robot"), section_at(env, _RANGES)
    keys = SIZES if _is_size(robot.get("size")) else ("standing_height",)
    sizes = {key: robot.get(key) for key in keys}
    for key in ("lin_vel_x", "ang_vel_z"):
        if isinstance(limits := ranges.get(key), list) and all(isinstance(limit, (int, float)) for limit in limits):
            sizes[key] = max(map(abs, limits), default=None)
    return [f"++env.robot.{key}={size!r}" for key, size in sizes.items() if _is_size(size)]


def register() -> None:
    """Make ``${sized:…}`` known to OmegaConf."""
    OmegaConf.register_new_resolver("sized", sized, replace=True)
