"""Where things stand in a recording: entity paths by environment and subject.

With one recorded environment paths are plain (``base/height``, ``world/<body>``); with several, each has its own
branch (``env_3/base/height``, ``world/env_3/<body>``).
"""

from __future__ import annotations

from dataclasses import dataclass

import rerun as rr

GROUND = "ground"
WORLD = "world"
OVERLAY = "overlay"
DOCUMENTS = "documents"
TRAINING = "training"

STEP, SIM_TIME, ITERATION = "step", "sim_time", "iteration"


def join(*parts: str) -> str:
    """Return an entity path whose parts are taken literally, whatever characters they hold."""
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


def key_below(root: str, entity: str) -> str | None:
    """Return the key that ``join_key(root, key)`` puts at ``entity``, None for an entity elsewhere."""
    head = f"{root}/"
    return entity.removeprefix(head).replace("\\", "") if entity.startswith(head) else None
