"""Define the paths of the Rerun entities in a recording.

If one environment is recorded, its entity paths have no prefix (``base/height``, ``world/<body>``). If several
environments are recorded, each environment has its own prefix (``env_3/base/height``, ``world/env_3/<body>``).
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
HIDDEN = "__"  # Rerun's viewer hides each entity whose path starts with two underscores.
PROPERTIES = "__properties"
OWN = "wheelleg"  # This program stores a recording's properties, such as its purpose, below the key `wheelleg`.
BRANCH = re.compile(r"^env_([0-9]{1,9})/")

FORMAT_VERSION = 2  # Recordings of format 1 lack metadata such as the seed, and store one vector per observation group.
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
    """Join names to a Rerun entity path, and escape special characters in the names."""
    import rerun as rr  # Import Rerun only here, because the import takes 0.25 s.

    return "/".join(rr.escape_entity_path_part(part) for part in parts if part)


def join_key(root: str, key: str) -> str:
    """Return the Rerun entity path, below ``root``, for the key of a scalar such as ``Episode_Reward/alive``."""
    return join(root, *key.split("/"))


@dataclass(frozen=True)
class EnvPaths:
    """Builds the Rerun entity paths of one environment, which contain ``branch`` (empty, or such as ``env_3``)."""

    branch: str

    def data(self, *parts: str) -> str:
        """Return the Rerun entity path of the environment's numbers or texts, such as ``env_3/base/height``."""
        return join(self.branch, *parts)

    def body(self, name: str, *parts: str) -> str:
        """Return the Rerun entity path of a MuJoCo body, or of a geom that is fixed to the body."""
        return join(WORLD, self.branch, name, *parts)

    def overlay(self, *parts: str) -> str:
        """Return the Rerun entity path of arrows, colliders, or other overlays in the 3D view."""
        return join(OVERLAY, self.branch, *parts)


def unit(entity: str) -> str | None:
    """Return the unit of all numbers in a Rerun entity; None if the numbers have no unit or have different units."""
    parts = entity.strip("/").split("/")
    if parts[0].startswith("env_") and len(parts) > 2:
        parts = parts[1:]
    for pattern, found in _UNITS.items():
        if len(pattern) == len(parts) and all(p in ("*", q) for p, q in zip(pattern, parts, strict=True)):
            return found
    return None


def unescaped(part: str) -> str:
    """Remove the escape characters from a name in a Rerun entity path."""
    return re.sub(r"\\(.)", r"\1", part)


def key_below(root: str, entity: str) -> str | None:
    """Return the scalar's key, such as ``Loss/value``, for a Rerun entity path below ``root``; None for other paths."""
    head = f"{root}/"
    return unescaped(entity.removeprefix(head)) if entity.startswith(head) else None
