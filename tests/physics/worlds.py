"""Bodies whose motion has a closed form, and nodes of terms for them. SI units."""

from __future__ import annotations

from typing import Any

import torch
from sim.small_envs import ACTUATORS, env_config

MDP = "wheelleg_exp.mdp."
G = 9.81  # m/s^2

# A free body of 2 kg: its centre of mass beside its frame, its three moments of inertia different.
STONE = """
<mujoco model="stone">
  <worldbody>
    <body name="stone">
      <freejoint/>
      <inertial pos=".05 -.02 .03" mass="2" diaginertia=".02 .03 .04"/>
      <geom type="sphere" size=".1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""

# A pendulum on a fixed base: 0.5 kg at 0.3 m below a hinge, with its own moment of inertia about it.
PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="mount">
      <geom type="sphere" size=".01" contype="0" conaffinity="0" mass="1"/>
      <body name="bob">
        <joint name="hinge" axis="0 1 0"/>
        <inertial pos="0 0 -.3" mass=".5" diaginertia=".004 .004 .004"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def term(module: str, name: str, **fields: Any) -> dict[str, Any]:
    """Return the node of a stock term."""
    return {"_target_": f"{MDP}{module}.{name}", **fields}


def seen(*names: str) -> dict[str, Any]:
    """Return observations of one group, ``seen``, of these terms by themselves."""
    terms = {name: term("observations", name) for name in names}
    return {"seen": {"concatenate_terms": False, "terms": terms}}


def at_reset(name: str, **fields: Any) -> dict[str, Any]:
    """Return the node of an event at each reset."""
    return term("events", name, mode="reset", **fields)


def placed(pose: dict[str, float] | None = None, velocity: dict[str, float] | None = None) -> dict[str, Any]:
    """Return the event that places the root: m and rad beside its default, m/s and rad/s."""
    ranges = [{axis: [value, value] for axis, value in (given or {}).items()} for given in (pose, velocity)]
    return at_reset("reset_root_state_uniform", pose_range=ranges[0], velocity_range=ranges[1])


def config(dt: float, base: str = "floating", **changes: Any) -> dict[str, Any]:
    """Return an env config for a robot without drives at the world's origin; sim, scene and robot are merged."""
    floating = {"to_default": at_reset("reset_scene_to_default")} if base == "floating" else {}
    state = {"pos": [0.0, 0.0, 0.0], "rot": [1.0, 0.0, 0.0, 0.0], "joint_pos": {}, "joint_vel": {}}
    robot = {"base": base, "init_state": state, "actuators": {}, **changes.pop("robot", {})}
    sim = {"dt": dt, **changes.pop("sim", {})}
    scene = {"sensors": {}, **changes.pop("scene", {})}
    given = {"num_envs": 1, "decimation": 1, "episode_length_s": 1e4, "actions": {}, "events": floating, **changes}
    return env_config(sim=sim, scene=scene, robot=robot, **given)


def watch(env: Any, steps: int, action: float = 0.0) -> dict[str, torch.Tensor]:
    """Return what each term shows at the reset and after each of the steps, (steps + 1, N, ...), in float64."""
    shown = [env.reset()[0]["seen"]]
    actions = torch.full((env.num_envs, env.action_manager.total_action_dim), action)
    shown += [env.step(actions)[0]["seen"] for _ in range(steps)]
    return {name: torch.stack([values[name] for values in shown]).double() for name in shown[0]}


def drive(kind: str, joint: str, **numbers: float) -> dict[str, Any]:
    """Return one actuator group with one joint and no stiffness."""
    return {"one": {"_target_": ACTUATORS + kind, "joint_names_expr": [joint], "stiffness": 0.0, **numbers}}
