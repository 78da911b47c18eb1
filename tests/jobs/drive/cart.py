"""A cart on four wheels that roll without slip, and the driver of the cart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from sim.small_envs import env_config

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.drive.drive_session import DriveSession
from wheelleg_exp.rl.vec_env import RslRlVecEnv

RADIUS, HALF_TRACK = 0.05, 0.1  # m
_WHEEL = """<body name="{name}" pos="{x} {y} 0"><joint name="{name}_axle" axis="0 1 0" armature="0.001"/>
<geom type="sphere" size="0.05" mass="0.1" friction="1.0 0.0001 0.0001"/></body>"""
_WHEELS = [("fl", 0.1, HALF_TRACK), ("fr", 0.1, -HALF_TRACK), ("rl", -0.1, HALF_TRACK), ("rr", -0.1, -HALF_TRACK)]
_CART = (
    '<mujoco><compiler angle="radian"/><worldbody><body name="base" pos="0 0 0.05"><freejoint/>'
    '<geom type="box" size="0.1 0.05 0.02" mass="1"/>'
    + "".join(_WHEEL.format(name=name, x=x, y=y) for name, x, y in _WHEELS)
    + "</body></worldbody></mujoco>"
)
VELOCITY = {
    "_target_": "wheelleg_exp.mdp.commands.UniformVelocityCommand",
    "ranges": {"lin_vel_x": [-0.4, 0.4], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-0.5, 1.0], "heading": None},
    "resampling_time_range": [0.1, 0.1],
    "rel_standing_envs": 0.0,
}


def cart_env(folder: Path, **changes: Any) -> ManagerBasedRLEnv:
    """Return an environment of one cart at 50 Hz whose observation is the command."""
    path = folder / "cart.xml"
    path.write_text(_CART)
    axles = {
        "_target_": "wheelleg_exp.sim.actuators.ImplicitActuator",
        "joint_names_expr": [".*_axle"],
        "stiffness": 0.0,
        "damping": 0.5,
        "effort_limit": 5.0,
        "velocity_limit": 100.0,
    }
    state = {"pos": [0.0, 0.0, 0.05], "rot": [1.0, 0.0, 0.0, 0.0], "joint_pos": {".*": 0.0}, "joint_vel": {".*": 0.0}}
    sections = {
        "num_envs": 1,
        "episode_length_s": 1000.0,
        "robot": {"asset": "cart.xml", "init_state": state, "actuators": {"axles": axles}},
        "scene": {"sensors": {}},
        "commands": {"base_velocity": VELOCITY},
        "actions": {"axles": {"_target_": "wheelleg_exp.mdp.actions.JointVelocityAction", "joint_names": [".*_axle"]}},
        "observations": {
            "policy": {
                "terms": {
                    "command": {
                        "_target_": "wheelleg_exp.mdp.observations.generated_commands",
                        "command_name": "base_velocity",
                    }
                }
            }
        },
        **changes,
    }
    return ManagerBasedRLEnv(env_config("rover", **sections), path, 0)


def driver(env: ManagerBasedRLEnv) -> Callable[[Any], torch.Tensor]:
    """Return a policy that turns the wheels as the command asks: (v -+ w * half track) / radius."""
    sides = torch.tensor([-1.0 if name[1] == "l" else 1.0 for name in env.action_manager.get_term("axles").joint_names])

    def policy(observations: Any) -> torch.Tensor:
        v, _, w = observations["policy"].unbind(dim=1)
        return (v.unsqueeze(1) + sides * HALF_TRACK * w.unsqueeze(1)) / RADIUS

    return policy


def cart(folder: Path, **changes: Any) -> DriveSession:
    env = cart_env(folder, **changes)
    return DriveSession(RslRlVecEnv(env), driver(env))
