"""Idioms of user-defined terms for Isaac Lab, one in each row with a known number, and the page that lists names."""

import runpy
from pathlib import Path

import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab.envs.mdp import joint_pos_limit_normalized as limited
from wheelleg_exp.isaaclab.managers import ManagerTermBase, SceneEntityCfg
from wheelleg_exp.isaaclab.utils import string
from wheelleg_exp.isaaclab.utils.buffers import CircularBuffer, DelayBuffer
from wheelleg_exp.managers import TermBase
from wheelleg_exp.terms.term_binding import takes_cfg

DOCS = Path(__file__).parents[2] / "docs"
N, J = 4, 4
MDP = "wheelleg_exp.mdp."
RANGES = {"lin_vel_x": [-0.5, 0.5], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-1.0, 1.0]}
COMMAND = {"_target_": MDP + "commands.UniformVelocityCommand", "resampling_time_range": [1.0, 3.0], "ranges": RANGES}
PLACE = {"_target_": MDP + "events.reset_joints_by_offset", "mode": "reset"}
SECTIONS = {
    "rewards": {
        "alive": {"_target_": MDP + "rewards.is_alive", "weight": 1.5},
        "heavy": {"_target_": MDP + "rewards.lin_vel_z_l2", "weight": -2.0},
    },
    "terminations": {"time_out": {"_target_": MDP + "terminations.time_out", "time_out": True}},
    "commands": {"base_velocity": COMMAND},
    "actions": {"hips": {"_target_": MDP + "actions.JointPositionAction", "joint_names": [".*_hip"], "scale": 0.5}},
    "events": {"place": {**PLACE, "position_range": [0.0, 0.0], "velocity_range": [0.0, 0.0]}},
}


@pytest.fixture(scope="module")
def env():
    from sim.small_envs import ASSETS, env_config

    from wheelleg_exp.env import ManagerBasedRLEnv

    env = ManagerBasedRLEnv(env_config("rover", **SECTIONS), ASSETS / "rover.xml", 0)
    env.reset()
    for _ in range(3):
        env.step(torch.full((N, 2), 0.2))
    return env


def robot(env):
    return env.scene["robot"]


def data(env):
    return robot(env).data


def resolved(env, **names):
    cfg = SceneEntityCfg("robot", **names)
    cfg.resolve(env.scene)
    return cfg


class EnvFirst(ManagerTermBase):
    def __init__(self, env, cfg):
        super().__init__(cfg, env)


class Native(TermBase):
    def __init__(self, env, cfg):
        self.cfg = cfg


def shape(*of):
    return lambda found: tuple(found.shape) == of


IDIOMS = [
    # the environment
    ("env.cfg.decimation", lambda e: e.cfg.decimation, 2),
    ("env.cfg.sim.dt", lambda e: e.cfg.sim.dt, 0.01),
    ("env.cfg.episode_length_s", lambda e: e.cfg.episode_length_s, 2.0),
    ("env.cfg.scene.num_envs", lambda e: e.cfg.scene.num_envs, N),
    ("env.cfg.rewards.x.weight", lambda e: e.cfg.rewards.alive.weight, 1.5),
    ("env.cfg.commands.x.ranges", lambda e: e.cfg.commands.base_velocity.ranges.lin_vel_x, [-0.5, 0.5]),
    ("env.cfg.events.x.params", lambda e: e.cfg.events.place.params["position_range"], [0.0, 0.0]),
    ("env.unwrapped", lambda e: e.unwrapped is e, True),
    ("env.reset_buf", lambda e: e.reset_buf.tolist(), [False] * N),
    ("env.reset_terminated", lambda e: e.reset_terminated.any().item(), False),
    ("env.reset_time_outs", lambda e: e.reset_time_outs.any().item(), False),
    ("env.obs_buf", lambda e: e.obs_buf["policy"], lambda found: found.shape[0] == N),
    ("env._sim_step_counter", lambda e: e._sim_step_counter, 6),
    ("env.sim.get_physics_dt", lambda e: e.sim.get_physics_dt(), 0.01),
    ("env.sim.cfg.dt", lambda e: e.sim.cfg.dt, 0.01),
    ("env.sim.device", lambda e: torch.zeros(1, device=e.sim.device).item(), 0.0),
    ("env.num_actions", lambda e: e.num_actions, 2),
    # the scene
    ("scene.env_regex_ns", lambda e: e.scene.env_regex_ns, "/World/envs/env_.*"),
    ("scene.keys", lambda e: list(e.scene.keys()), ["robot", "terrain", "contact"]),
    ("scene.articulations", lambda e: e.scene.articulations["robot"] is e.scene["robot"], True),
    ("scene.rigid_objects", lambda e: len(e.scene.rigid_objects), 0),
    ("scene.cfg.terrain", lambda e: e.scene.cfg.terrain.terrain_type, "plane"),
    ("hasattr terrain_levels", lambda e: hasattr(e.scene.terrain, "terrain_levels"), False),
    ("sensor.cfg", lambda e: e.scene.sensors["contact"].cfg.track_air_time, True),
    ("sensor.num_bodies", lambda e: e.scene.sensors["contact"].num_bodies, lambda n: n > 0),
    # the managers
    ("manager _term_names", lambda e: e.reward_manager._term_names, ["alive", "heavy"]),
    ("a term by keyword", lambda e: (takes_cfg(EnvFirst), takes_cfg(Native)), (True, False)),
    ("command_manager.get_term", lambda e: e.command_manager.get_term("base_velocity").time_left, shape(N)),
    ("command.cfg.ranges", lambda e: e.command_manager.get_term("base_velocity").cfg.ranges.lin_vel_x, (-0.5, 0.5)),
    ("action_manager.get_term", lambda e: e.action_manager.get_term("hips").raw_actions[0].tolist(), [0.2, 0.2]),
    ("reward get_term_cfg", lambda e: e.reward_manager.get_term_cfg("heavy").weight, -2.0),
    ("reward _episode_sums", lambda e: e.reward_manager._episode_sums["alive"].tolist(), 4 * [1.5 * 3 * 0.02]),
    ("reward find_terms", lambda e: e.reward_manager.find_terms("al.*"), ["alive"]),
    ("reward per env", lambda e: e.reward_manager.get_active_iterable_terms(1)[0], ("alive", [1.5])),
    ("termination get_term", lambda e: e.termination_manager.get_term("time_out").tolist(), [False] * N),
    ("termination get_term_cfg", lambda e: e.termination_manager.get_term_cfg("time_out").time_out, True),
    ("event get_term_cfg", lambda e: e.event_manager.get_term_cfg("place").params["velocity_range"], [0.0, 0.0]),
    ("event active_terms", lambda e: e.event_manager.active_terms, {"reset": ["place"]}),
    # entities
    ("SceneEntityCfg default", lambda e: SceneEntityCfg("robot").joint_ids, slice(None)),
    ("SceneEntityCfg by ids", lambda e: resolved(e, joint_ids=[1, 0]).joint_ids.tolist(), [1, 0]),
    ("SceneEntityCfg names", lambda e: resolved(e, joint_names=".*_hip").joint_names, ["left_hip", "right_hip"]),
    ("SceneEntityCfg tendons", lambda e: SceneEntityCfg("robot").fixed_tendon_ids, slice(None)),
    # the robot
    ("find_joints", lambda e: robot(e).find_joints(["left_axle"])[0], [2]),
    ("find_bodies", lambda e: robot(e).find_bodies("base")[1], ["base"]),
    ("num_joints", lambda e: robot(e).num_joints, J),
    ("is_fixed_base", lambda e: robot(e).is_fixed_base, False),
    ("asset.device", lambda e: torch.zeros(2, device=robot(e).device).tolist(), [0.0, 0.0]),
    ("root_state_w", lambda e: data(e).root_state_w, shape(N, 13)),
    ("default_root_state", lambda e: data(e).default_root_state[:, 2].tolist(), pytest.approx([0.3] * N)),
    ("body_state_w", lambda e: data(e).body_state_w, lambda found: found.shape[2] == 13),
    ("soft limits", lambda e: data(e).soft_joint_pos_limits[:, [0, 1], 1].tolist(), N * [[1.5, 1.5]]),
    ("GRAVITY_VEC_W", lambda e: data(e).GRAVITY_VEC_W[1].tolist(), [0.0, 0.0, -1.0]),
    ("default_mass", lambda e: data(e).default_mass.sum(dim=1)[0].item(), lambda found: found > 0.1),
    ("joint_stiffness", lambda e: data(e).joint_stiffness, shape(N, J)),
    ("joint_pos_limit_normalized", lambda e: limited(e, resolved(e, joint_names=".*_hip")), shape(N, 2)),
    # the utilities
    ("resolve_matching_names", lambda e: string.resolve_matching_names("b.*", ["ab", "ba", "bc"])[1], ["ba", "bc"]),
]


@pytest.mark.parametrize(("ask", "expected"), [row[1:] for row in IDIOMS], ids=[row[0] for row in IDIOMS])
def test_an_idiom(env, ask, expected):
    found = ask(env)
    if callable(expected):
        assert expected(found)
    elif isinstance(found, list) and found and isinstance(found[0], float):
        assert found == pytest.approx(expected)
    else:
        assert found == expected


def test_a_term_is_replaced_by_another_config(make_env):
    env = make_env(**SECTIONS)
    cfg = env.reward_manager.get_term_cfg("heavy")
    cfg.weight = -4.0
    env.reward_manager.set_term_cfg("heavy", cfg)
    env.reset()
    env.step(torch.zeros(N, 2))
    speed = env.scene.robot.data.root_lin_vel_b[:, 2]
    torch.testing.assert_close(env.reward_manager.step_reward[1], -4.0 * speed.square())
    other = make_env(**SECTIONS)
    other.load_state_dict(env.state_dict())
    assert other.reward_manager.get_term_cfg("heavy").weight == -4.0


def test_ranges_of_commands_are_set_by_attribute(make_env):
    env = make_env(**SECTIONS)
    env.command_manager.get_term("base_velocity").cfg.ranges.lin_vel_x = (2.0, 3.0)
    env.reset()
    drawn = env.command_manager.get_command("base_velocity")[:, 0]
    assert 2.0 <= float(drawn.min()) <= float(drawn.max()) <= 3.0


def test_there_are_as_many_idioms_as_the_page_states_and_the_config_is_read_only(env):
    assert len(IDIOMS) == 56
    with pytest.raises(ConfigError, match=r"env.rewards.alive.weight: .*config is read-only.*get_term_cfg"):
        env.cfg.rewards.alive.weight = 2.0
    with pytest.raises(AttributeError, match=r"env.rewards.alife: .*did you mean 'alive'"):
        env.cfg.rewards.alife  # noqa: B018
    assert (env.cfg["rewards"]["alive"]["weight"], dict(env.cfg.rewards)) == (1.5, env.cfg["rewards"])
    with pytest.raises(ConfigError, match="fixed_tendon_names"):  # The scene has no tendons.
        resolved(env, fixed_tendon_names=["a"])


def test_buffers_store_the_last_samples_of_each_environment():
    """The first sample after a reset also fills the older places, as in Isaac Lab."""
    late, again = (DelayBuffer(history_length=2, batch_size=3, device="cpu") for _ in range(2))
    late.set_time_lag(torch.tensor([0, 1, 2]))
    seen = [late.compute(torch.full((3, 1), float(k)))[:, 0].tolist() for k in range(4)]
    assert seen == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 1.0, 0.0], [3.0, 2.0, 1.0]]
    again.load_state_dict(late.state_dict())
    again.reset([2])
    assert again._buffer.buffer[:, :, 0].tolist() == [[1.0, 2.0, 3.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]
    assert again._buffer.current_length.tolist() == [3, 3, 0]
    assert again.compute(torch.full((3, 1), 9.0))[:, 0].tolist() == [9.0, 3.0, 9.0]
    with pytest.raises(ValueError, match="the delay is 3, expected 0 to 2"):
        late.set_time_lag(3)
    with pytest.raises(RuntimeError, match="append first"):
        CircularBuffer(2, 1, "cpu")[torch.zeros(1, dtype=torch.long)]


def test_the_tables_are_what_the_code_has():
    maker = runpy.run_path(str(DOCS / "make_isaaclab.py"))
    made = maker["page"]()
    assert (DOCS / "tables/isaaclab_names.md").read_text(encoding="utf-8") == made, "run: python docs/make_reference.py"
    assert "|  |" not in made
    names = maker["names"]()["names"]["ArticulationData"]  # all fields of Isaac Lab's class
    assert len(names) == len(set(names)) == 129
    assert {"root_state_w", "joint_limits", "com_pos_b", "GRAVITY_VEC_W"} <= set(names)
