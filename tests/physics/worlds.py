from typing import Any

import torch
from sim.small_envs import env_config

MDP = "wheelleg_exp.mdp."
G = 9.81  # m/s^2

# A free body of 2 kg with three different moments of inertia. Its centre of mass is not at its origin.
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


def mounted(name: str, bodies: str) -> str:
    """Return the MJCF of a fixed mount that carries bodies."""
    mount = f'<geom type="sphere" size=".01" contype="0" conaffinity="0" mass="1"/>\n{bodies}'
    return f'<mujoco model="{name}"><worldbody><body name="mount">{mount}</body></worldbody></mujoco>'


# A pendulum on a fixed base, with a mass of 0.5 kg at 0.3 m below the hinge, and a moment of inertia.
BOB = """<body name="bob">
  <joint name="hinge" axis="0 1 0"/>
  <inertial pos="0 0 -.3" mass=".5" diaginertia=".004 .004 .004"/>
</body>"""
PENDULUM = mounted("pendulum", BOB)


def term(module: str, name: str, **fields: Any) -> dict[str, Any]:
    return {"_target_": f"{MDP}{module}.{name}", **fields}


def seen(*names: str) -> dict[str, Any]:
    return {"seen": {"concatenate_terms": False, "terms": {name: term("observations", name) for name in names}}}


def at_reset(name: str, **fields: Any) -> dict[str, Any]:
    return term("events", name, mode="reset", **fields)


def placed(pose: dict[str, float] | None = None, velocity: dict[str, float] | None = None) -> dict[str, Any]:
    ranges = [{axis: [value, value] for axis, value in (given or {}).items()} for given in (pose, velocity)]
    return at_reset("reset_root_state_uniform", pose_range=ranges[0], velocity_range=ranges[1])


def config(dt: float, base: str = "floating", **changes: Any) -> dict[str, Any]:
    floating = {"to_default": at_reset("reset_scene_to_default")} if base == "floating" else {}
    state = {"pos": [0.0, 0.0, 0.0], "rot": [1.0, 0.0, 0.0, 0.0], "joint_pos": {}, "joint_vel": {}}
    robot = {"base": base, "init_state": state, "actuators": {}, **changes.pop("robot", {})}
    sim = {"dt": dt, **changes.pop("sim", {})}
    scene = {"sensors": {}, **changes.pop("scene", {})}
    given = {"num_envs": 1, "decimation": 1, "episode_length_s": 1e4, "actions": {}, "events": floating, **changes}
    return env_config(sim=sim, scene=scene, robot=robot, **given)


def depth_in_step(centres: torch.Tensor, axes: torch.Tensor, face: float, top: float) -> torch.Tensor:
    """Return how far (N,) the rims of the stock robot's wheels are inside a step that fills x > face, z < top, m.

    ``centres`` (N, 3), m, and ``axes`` (N, 3), unit vectors, are the wheels' poses in the world.
    """
    radius, half_width = 0.02, 0.006  # m
    forward = torch.nn.functional.normalize(torch.linalg.cross(axes, torch.tensor([[0.0, 0.0, 1.0]]).to(axes)), dim=1)
    upward = torch.linalg.cross(forward, axes)
    turns = torch.linspace(0.0, 2.0 * torch.pi, 721, dtype=axes.dtype)[:, None, None]
    circle = centres + radius * (turns.cos() * forward + turns.sin() * upward)
    rims = torch.cat((circle - half_width * axes, circle + half_width * axes))
    return torch.minimum(rims[..., 0] - face, top - rims[..., 2]).amax(dim=0).clamp(min=0.0)


def watch(env: Any, steps: int, action: float = 0.0) -> dict[str, torch.Tensor]:
    shown = [env.reset()[0]["seen"]]
    actions = torch.full((env.num_envs, env.action_manager.total_action_dim), action)
    shown += [env.step(actions)[0]["seen"] for _ in range(steps)]
    return {name: torch.stack([values[name] for values in shown]).double() for name in shown[0]}
