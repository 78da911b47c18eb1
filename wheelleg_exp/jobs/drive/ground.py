"""Which environment is driven: one robot of the run's, on its own ground or another, that nothing disturbs unasked."""

from __future__ import annotations

import copy

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining.catalog import options
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.jobs.run_policy import Tree
from wheelleg_exp.packages import with_current

OWN = "own"  # the run's own ground
_GROUP = "scene"
_UNASKED = ("interval", "step")  # modes of events that act while an episode goes on


def scenes() -> list[str]:
    """Return the grounds that can be chosen: the run's own, and the options of the config group ``scene``."""
    return [OWN, *(entry.name for entry in options(_GROUP, with_current([])))]


def require_scene(name: str) -> None:
    """Raise ConfigError for a ground that there is not."""
    known = scenes()
    if name not in known:
        raise ConfigError(
            f"there is no ground '{name}'",
            key="--scene",
            expected="one of " + ", ".join(known),
            nearest=nearest_name(name, known),
        )


def drivable(tree: Tree, scene: str = OWN) -> Tree:
    """Return a play's tree for driving.

    One robot; episodes as long as ``drive.episode_length_s``; no events but those of starts and resets, and no
    curriculum; commands that follow the hand instead of a heading or a share that stands.

    Args:
        tree: the tree.
        scene: option of ``scene`` whose ground takes the place of the run's, or ``own``.
    """
    tree = copy.deepcopy(tree)
    env = tree["env"]
    env["num_envs"] = 1
    env["episode_length_s"] = tree["drive"]["episode_length_s"]
    env["events"] = {k: node for k, node in (env.get("events") or {}).items() if node.get("mode") not in _UNASKED}
    env["curriculum"] = {}
    for node in (env.get("commands") or {}).values():
        node |= {k: v for k, v in {"rel_standing_envs": 0.0, "heading_command": False}.items() if k in node}
        if "heading_command" in node:
            node["ranges"] = {**node["ranges"], "heading": None}
    if scene != OWN:
        env["scene"] = _on(env["scene"], scene)
    return tree


def _on(own: Tree, name: str) -> Tree:
    """Return a scene with another's ground, and what the sensors of both need there; the run's others stay."""
    other = compose([f"+{_GROUP}={name}"], primary="play", config_dirs=with_current([])).config["env"]["scene"]
    shared = {key: node for key, node in other.get("sensors", {}).items() if key in (own.get("sensors") or {})}
    ground = {key: value for key, value in other.items() if key != "sensors"}
    return {**own, **ground, "sensors": {**(own.get("sensors") or {}), **shared}}
