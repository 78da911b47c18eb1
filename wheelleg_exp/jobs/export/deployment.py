"""The environment of a run as a deployer's robot meets it: one simulation, and what the world adds left out."""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from typing import Any

_BIAS = "wheelleg_exp.mdp.events.randomize_encoder_bias"
_RESET = "wheelleg_exp.mdp.events.reset_joints_by_scale"
_ENTITY = "wheelleg_exp.managers.SceneEntityCfg"
_PLANE = "wheelleg_exp.sim.terrain.Plane"


def as_configured(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ``env`` section for one simulation whose numbers nothing draws or changes: no events, no curriculum.

    Args:
        env: the run's section, plain; it stays as it is.
    """
    found = copy.deepcopy(dict(env)) | {"num_envs": 1, "events": {}, "curriculum": {}, "recorders": {}}
    found["sim"]["nthread"] = 1
    return found


def as_checked(env: Mapping[str, Any], rolling_joints: Sequence[str]) -> dict[str, Any]:
    """Return the ``env`` section for episodes that a runner can repeat from readings.

    Noise and delays belong to the sensors and the way to the drives, which a robot has by itself: they are left out.
    So are errors of encoders, pushes between two readings and what is drawn once of the robot. Resets stay, but rolling
    joints then are at their defaults, because a runner counts their positions from there.

    Args:
        env: the run's section, plain; it stays as it is.
        rolling_joints: the joints whose positions count from the reset.
    """
    found = as_configured(env)
    events = {name: node for name, node in env["events"].items() if node is not None and node["_target_"] != _BIAS}
    found["events"] = {name: copy.deepcopy(node) for name, node in events.items() if node["mode"] == "reset"}
    if rolling_joints:
        joints = {"_target_": _ENTITY, "name": "robot", "joint_names": [*map(re.escape, rolling_joints)]}
        still = {"position_range": [1.0, 1.0], "velocity_range": [1.0, 1.0], "asset_cfg": joints}
        found["events"]["rolling_joints_at_default"] = {"_target_": _RESET, "mode": "reset", **still}
    for group in (group for group in found["observations"].values() if group is not None):
        group["enable_corruption"] = False
        for node in (node for node in group["terms"].values() if node is not None):
            node.pop("delay", None)
    for node in (node for node in found["actions"].values() if node is not None):
        node.pop("delay", None)
    return found


def as_simulated(env: Mapping[str, Any], friction: tuple[float, float, float]) -> dict[str, Any]:
    """Return the ``env`` section of a scene with nothing but the robot on level ground.

    Args:
        env: the run's section, plain; it stays as it is.
        friction: the ground's static and dynamic friction and its restitution.
    """
    found = as_configured(env)
    names = ("static_friction", "dynamic_friction", "restitution")
    plane = {"_target_": _PLANE, **dict(zip(names, friction, strict=True))}
    found["scene"] = {**found["scene"], "terrain": plane, "sensors": {}}
    return found
