"""Where things stand in a recording: entity paths by environment and subject.

With one recorded environment paths are plain (``base/height``, ``world/<body>``); with several, each has its own
branch (``env_3/base/height``, ``world/env_3/<body>``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass

GROUND = "ground"
WORLD = "world"
OVERLAY = "overlay"
DOCUMENTS = "documents"
TRAINING = "training"
LOG = "log"
HIDDEN = "__"  # what begins so is hidden by rerun: properties and the journal
JOURNAL = f"__journal/{TRAINING}"
PROPERTIES = "__properties"
OWN = "wheelleg"  # this program's properties
BRANCH = re.compile(r"^env_([0-9]{1,9})/")

FORMAT_VERSION = 2  # 1 had no properties, and one vector for each observation group

STEP, SIM_TIME, ITERATION = "step", "sim_time", "iteration"

_METRES, _ANGLE, _SPEED, _TURNING, _TORQUE = "m", "rad", "m/s", "rad/s", "N·m"
_UNITS: dict[tuple[str, ...], str] = {
    ("base", "height"): _METRES,
    **{("base", name): _ANGLE for name in ("roll", "pitch", "yaw")},
    **{("base", name): _SPEED for name in ("v_x", "v_y", "v_z")},
    **{("base", name): _TURNING for name in ("w_x", "w_y", "w_z")},
    **{("commands", "*", name): _SPEED for name in ("v_x", "v_y")},
    ("commands", "*", "w_z"): _TURNING,
    **{("joints", "*", name): _ANGLE for name in ("position", "position_target")},
    **{("joints", "*", name): _TURNING for name in ("velocity", "velocity_target")},
    **{("joints", "*", name): _TORQUE for name in ("effort", "effort_computed")},
    ("contacts", "*"): "N",
    ("contacts", "*", "forces"): "N",
    ("contacts", "*", "peak"): "N",
    ("rewards", "*"): "1/s",
    ("episode", "step"): "steps",
}


def join(*parts: str) -> str:
    """Return an entity path whose parts are taken literally, whatever characters they hold."""
    import rerun as rr  # not at the top: reading a recording needs no more of rerun than this, and not always

    return "/".join(rr.escape_entity_path_part(part) for part in parts if part)


def join_key(root: str, key: str) -> str:
    """Return the path of a key such as ``Episode_Reward/alive`` below ``root``."""
    return join(root, *key.split("/"))


@dataclass(frozen=True)
class EnvPaths:
    """Paths of one recorded environment.

    Attributes:
        branch: the environment's branch, empty when it is the only one.
    """

    branch: str

    def data(self, *parts: str) -> str:
        """Return the path of numbers and text."""
        return join(self.branch, *parts)

    def body(self, name: str, *parts: str) -> str:
        """Return the path of a body, or of something fixed to it."""
        return join(WORLD, self.branch, name, *parts)

    def overlay(self, *parts: str) -> str:
        """Return the path of something drawn over the world: arrows, colliders."""
        return join(OVERLAY, self.branch, *parts)


def unit(entity: str) -> str | None:
    """Return the unit of an entity's numbers, None where they have none or several."""
    parts = entity.strip("/").split("/")
    if parts[0].startswith("env_") and len(parts) > 2:
        parts = parts[1:]
    for pattern, found in _UNITS.items():
        if len(pattern) == len(parts) and all(p in ("*", q) for p, q in zip(pattern, parts, strict=True)):
            return found
    return None


def key_below(root: str, entity: str) -> str | None:
    """Return the key that ``join_key(root, key)`` puts at ``entity``, None for an entity elsewhere."""
    head = f"{root}/"
    return entity.removeprefix(head).replace("\\", "") if entity.startswith(head) else None
