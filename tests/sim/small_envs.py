import copy
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from wheelleg_exp.env import ManagerBasedRLEnv

ASSETS = Path(__file__).parents[1] / "assets"
ACTUATORS = "wheelleg_exp.sim.actuators."
PLANE = "wheelleg_exp.sim.terrain.Plane"


def init_state(height: float, joint_pos: Mapping[str, float]) -> dict[str, Any]:
    return {"pos": [0.0, 0.0, height], "rot": [1.0, 0.0, 0.0, 0.0], "joint_pos": joint_pos, "joint_vel": {".*": 0.0}}


def _drive(
    joint: str, kp: float, kd: float, effort: float, speed: float, model: str = "ImplicitActuator"
) -> dict[str, Any]:
    gains = {"stiffness": kp, "damping": kd, "effort_limit": effort, "velocity_limit": speed}
    return {"_target_": ACTUATORS + model, "joint_names_expr": [joint], **gains}


CONTACT = {
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
        "sensors": {"contact": CONTACT},
    },
    "robot": {
        "profile": "test",
        "asset": "rover.xml",
        "base": "floating",
        "init_state": init_state(0.3, {".*_hip": 0.2, ".*_axle": 0.0}),
        "joint_order": None,
        "soft_joint_pos_limit_factor": 1.0,
        "friction_source": "static",
        "actuators": {
            "hips": {**_drive(".*_hip", 20.0, 1.0, 4.0, 30.0), "armature": 0.01},
            "axles": {**_drive(".*_axle", 0.0, 0.5, 2.0, 20.0), "armature": 0.01},
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
        "axles": {"_target_": "wheelleg_exp.mdp.actions.JointVelocityAction", "joint_names": [".*_axle"], "scale": 5.0},
    },
    "observations": {"policy": {"terms": {"joint_pos": {"_target_": "wheelleg_exp.mdp.observations.joint_pos"}}}},
    "events": {"to_default": {"_target_": "wheelleg_exp.mdp.events.reset_scene_to_default", "mode": "reset"}},
    "rewards": {},
    "terminations": {"time_out": {"_target_": "wheelleg_exp.mdp.terminations.time_out", "time_out": True}},
    "curriculum": {},
}

# A cube whose only joint has a drive with zero gains.
_BLOCK: dict[str, Any] = {
    "robot": {
        "asset": "block.xml",
        "init_state": init_state(0.1, {"spin": 0.0}),
        "actuators": {"spin": _drive("spin", 0.0, 0.0, 1.0, 1.0, "IdealPDActuator")},
    },
    "actions": {"spin": {"_target_": "wheelleg_exp.mdp.actions.JointVelocityAction", "joint_names": ["spin"]}},
}
_BLOCK["robot"] = {**_ROVER["robot"], **_BLOCK["robot"]}

_ARM: dict[str, Any] = {
    "robot": {
        **_ROVER["robot"],
        "asset": "arm.xml",
        "base": "fixed",
        "init_state": init_state(1.0, {"hinge": 0.1, "slider": 0.15}),
        "actuators": {"all": _drive(".*", 5.0, 1.0, 10.0, 10.0)},
    },
    "actions": {"all": {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": [".*"]}},
    "events": {},
}

_BASES: dict[str, dict[str, Any]] = {"rover": {}, "block": _BLOCK, "arm": _ARM}


def env_config(base: str = "rover", /, **changes: Any) -> dict[str, Any]:
    config = copy.deepcopy({**_ROVER, **_BASES[base]})
    for name, value in changes.items():
        if name in ("sim", "scene", "robot") and isinstance(value, Mapping):
            config[name] = {**config[name], **value}
        else:
            config[name] = value
    return copy.deepcopy(config)


def env_of(file: Path, config: dict[str, Any] | None = None) -> ManagerBasedRLEnv:
    return ManagerBasedRLEnv(env_config() if config is None else config, file, 0)


def variant(folder: Path, old: str, new: str, file: str = "rover.xml") -> Path:
    (folder / file).write_text((ASSETS / file).read_text().replace(old, new))
    return folder / file


def wheel_env(folder: Path, actuator: dict[str, Any], limited: str = "", **changes: Any) -> ManagerBasedRLEnv:
    """Build wheels of 0.01 kg·m² on fixed axles without gravity."""
    (folder / "wheel.xml").write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body name='mount'><body name='wheel'>"
        f"<joint name='axle' axis='0 1 0' {limited}/>"
        "<inertial pos='0 0 0' mass='1' diaginertia='.01 .01 .01'/></body></body></worldbody></mujoco>"
    )
    config = env_config("arm", actions={}, sim={"dt": 0.001, "gravity": [0.0, 0.0, 0.0]}, **changes)
    config["robot"]["init_state"] |= {"joint_pos": {}, "joint_vel": {}}
    config["robot"]["actuators"] = {"a": {"joint_names_expr": ["axle"], **actuator}}
    return env_of(folder / "wheel.xml", config)


def physics_step(env: ManagerBasedRLEnv, count: int = 1) -> None:
    for _ in range(count):
        env.scene.write_data_to_sim()
        env.scene.sim.step()
        env.scene.update()


def run(env: ManagerBasedRLEnv, steps: int = 1, action: float = 0.0) -> Any:
    for _ in range(steps):
        result = env.step(torch.full((env.num_envs, env.action_manager.total_action_dim), action, device=env.device))
    return result


@pytest.fixture
def start_env(make_env: Callable[..., ManagerBasedRLEnv]) -> Callable[..., ManagerBasedRLEnv]:
    """Build an environment as ``make_env`` does, and reset it."""

    def start(*args: Any, **changes: Any) -> ManagerBasedRLEnv:
        env = make_env(*args, **changes)
        env.reset()
        return env

    return start
