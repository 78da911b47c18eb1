"""Configs of small environments, to vary: a rover, a cube, and an arm on a fixed base."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parents[1] / "assets"
ACTUATORS = "wheelleg_exp.sim.actuators."
PLANE = "wheelleg_exp.sim.terrain.Plane"

_CONTACT = {
    "_target_": "wheelleg_exp.sim.sensors.ContactSensor",
    "body_names": [".*"],
    "history_length": 3,
    "track_air_time": True,
    "force_threshold": 1.0,
    "max_contacts": 4,
}

_ROVER: dict[str, Any] = {
    "num_envs": 4,
    "episode_length_s": 2.0,
    "decimation": 2,
    "sim": {
        "engine": "mujoco",
        "device": "cpu",
        "dt": 0.01,
        "gravity": [0.0, 0.0, -9.81],
        "integrator": "implicitfast",
        "solver": "newton",
        "cone": "pyramidal",
        "iterations": 100,
        "ls_iterations": 50,
        "tolerance": 1e-8,
        "impratio": 1.0,
        "nthread": 1,
    },
    "scene": {
        "env_spacing": 3.0,
        "terrain": {"_target_": PLANE, "static_friction": 0.5, "dynamic_friction": 0.4, "restitution": 0.0},
        "sensors": {"contact": _CONTACT},
    },
    "robot": {
        "profile": "test",
        "asset": "rover.xml",
        "base": "floating",
        "init_state": {
            "pos": [0.0, 0.0, 0.3],
            "rot": [1.0, 0.0, 0.0, 0.0],
            "joint_pos": {".*_hip": 0.2, ".*_axle": 0.0},
            "joint_vel": {".*": 0.0},
        },
        "joint_order": None,
        "soft_joint_pos_limit_factor": 1.0,
        "friction_source": "static",
        "actuators": {
            "hips": {
                "_target_": ACTUATORS + "ImplicitActuator",
                "joint_names_expr": [".*_hip"],
                "stiffness": 20.0,
                "damping": 1.0,
                "effort_limit": 4.0,
                "velocity_limit": 30.0,
                "armature": 0.01,
            },
            "axles": {
                "_target_": ACTUATORS + "ImplicitActuator",
                "joint_names_expr": [".*_axle"],
                "stiffness": 0.0,
                "damping": 0.5,
                "effort_limit": 2.0,
                "velocity_limit": 20.0,
                "armature": 0.01,
            },
        },
    },
    "commands": {},
    "actions": {
        "hips": {
            "_target_": "wheelleg_exp.mdp.actions.JointPositionAction",
            "joint_names": [".*_hip"],
            "scale": 0.5,
            "use_default_offset": True,
        },
        "axles": {
            "_target_": "wheelleg_exp.mdp.actions.JointVelocityAction",
            "joint_names": [".*_axle"],
            "scale": 5.0,
        },
    },
    "observations": {"policy": {"terms": {"joint_pos": {"_target_": "wheelleg_exp.mdp.observations.joint_pos"}}}},
    "events": {
        "to_default": {"_target_": "wheelleg_exp.mdp.events.reset_scene_to_default", "mode": "reset"},
    },
    "rewards": {},
    "terminations": {"time_out": {"_target_": "wheelleg_exp.mdp.terminations.time_out", "time_out": True}},
    "curriculum": {},
}

# A cube whose only joint has a drive without strength.
_BLOCK: dict[str, Any] = {
    "robot": {
        "asset": "block.xml",
        "init_state": {
            "pos": [0.0, 0.0, 0.1],
            "rot": [1.0, 0.0, 0.0, 0.0],
            "joint_pos": {"spin": 0.0},
            "joint_vel": {"spin": 0.0},
        },
        "actuators": {
            "spin": {
                "_target_": ACTUATORS + "IdealPDActuator",
                "joint_names_expr": ["spin"],
                "stiffness": 0.0,
                "damping": 0.0,
                "effort_limit": 1.0,
                "velocity_limit": 1.0,
            }
        },
    },
    "actions": {"spin": {"_target_": "wheelleg_exp.mdp.actions.JointVelocityAction", "joint_names": ["spin"]}},
}
_BLOCK["robot"] = {**_ROVER["robot"], **_BLOCK["robot"]}

_ARM: dict[str, Any] = {
    "robot": {
        **_ROVER["robot"],
        "asset": "arm.xml",
        "base": "fixed",
        "init_state": {
            "pos": [0.0, 0.0, 1.0],
            "rot": [1.0, 0.0, 0.0, 0.0],
            "joint_pos": {"hinge": 0.1, "slider": 0.15},
            "joint_vel": {".*": 0.0},
        },
        "actuators": {
            "all": {
                "_target_": ACTUATORS + "ImplicitActuator",
                "joint_names_expr": [".*"],
                "stiffness": 5.0,
                "damping": 1.0,
                "effort_limit": 10.0,
                "velocity_limit": 10.0,
            }
        },
    },
    "actions": {"all": {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": [".*"]}},
    "events": {},
}

_BASES: dict[str, dict[str, Any]] = {"rover": {}, "block": _BLOCK, "arm": _ARM}


def env_config(base: str = "rover", /, **changes: Any) -> dict[str, Any]:
    """Return an env config: sections replace the base's, except sim, scene and robot, whose keys are merged."""
    config = copy.deepcopy({**_ROVER, **_BASES[base]})
    for name, value in changes.items():
        if name in ("sim", "scene", "robot") and isinstance(value, Mapping):
            config[name] = {**config[name], **value}
        else:
            config[name] = value
    return copy.deepcopy(config)
