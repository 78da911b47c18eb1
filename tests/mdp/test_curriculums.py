import math
from types import SimpleNamespace

import pytest
import torch
from sim.small_envs import run

from mdp.fakes import fake_env
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.mdp import config_address, curriculums, schedules

T = torch.tensor
STILL = torch.zeros(4, 4)
HERE = "mdp.test_curriculums."
C = "wheelleg_exp.mdp.curriculums."
ALIVE = {"_target_": "wheelleg_exp.mdp.rewards.is_alive", "weight": 1.0}
VELOCITY = {
    "_target_": "wheelleg_exp.mdp.commands.UniformVelocityCommand",
    "resampling_time_range": [1.0, 1.0],
    "ranges": {"lin_vel_x": [-0.2, 0.3], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-1.0, 1.0]},
}
HEIGHT = {"_target_": "wheelleg_exp.mdp.rewards.base_height_l2", "weight": -1.0, "target_height": 0.1}
PUSH = {"_target_": "wheelleg_exp.mdp.events.push_by_setting_velocity", "velocity_range": {"x": [-0.5, 0.5]}}
PUSH |= {"mode": "interval", "interval_range_s": [1.0, 2.0]}
SPEED = VELOCITY | {"ranges": {"lin_vel_x": [0.2, 0.2], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [0.0, 0.0]}}
LEVELS_BY_SPEED = {"_target_": C + "terrain_levels_vel", "command_name": "v"}


def later(env, env_ids, old_value, add):
    return old_value + add if env.common_step_counter else curriculums.modify_env_param.NO_CHANGE


@pytest.fixture
def one(make_env, allow_test_terms):
    def make(**node):
        noise = {"_target_": "wheelleg_exp.mdp.noise.UniformNoise", "n_min": -0.1, "n_max": 0.1}
        terms = {"q": {"_target_": "wheelleg_exp.mdp.observations.joint_pos", "noise": noise}}
        observations = {"policy": {"terms": terms, "enable_corruption": True}}
        sections = {"commands": {"v": VELOCITY}, "rewards": {"alive": ALIVE, "low": HEIGHT}, "events": {"push": PUSH}}
        return make_env(observations=observations, curriculum={"c": node}, **sections)

    return make


def _pass(env, steps=1):
    run(env, steps)
    return env.reset()[1]["log"].get("Curriculum/c")


def test_levels_follow_the_way_that_was_made():
    """Tiles have 4 m, and episodes 10 s: robots go up beyond 2 m, and down below half of speed times 10 s."""
    moved = {}
    terrain = {
        "terrain_origins": (),
        "size": (4.0, 99.0),
        "terrain_levels": T([0, 1, 2, 3, 4]),
        "update_env_origins": lambda ids, up, down: moved.update(ids=ids, up=up.tolist(), down=down.tolist()),
    }
    env = fake_env(
        data_root_pos_w=T([[11.2, 20.0, 5.0], [9.9, 0, 0], [10.0, 21.9, 0], [12.0, 20.0, 0], [10.0, 17.9, 0]]),
        env_origins=T([[10.0, 20.0, 1.0]] * 5),
        commands={"base_velocity": T([[0.22, 0.0, 9.0], [9.0, 0, 0], [0.3, 0.4, 0], [0.5, 0.0, 0.0], [0.0, 0.8, 0]])},
        max_episode_length_s=10.0,
        terrain=terrain,
    )
    mean = curriculums.terrain_levels_vel(env, T([0, 2, 3, 4]))
    assert moved["ids"].tolist() == [0, 2, 3, 4]
    assert moved["up"] == [False, False, False, True]  # the distances are 1.2, 1.9, 2.0 and 2.1 m
    assert moved["down"] == [False, True, True, False]  # half of the commanded distances: 1.1, 2.5, 2.5 and 4 m
    assert float(mean) == 2.0


TILES = {
    "_target_": "wheelleg_exp.sim.terrain.TerrainGenerator",
    **{"size": [2.0, 3.0], "num_rows": 4, "num_cols": 2, "border_width": 1.0},
    **{"horizontal_scale": 0.5, "vertical_scale": 0.01, "curriculum": True, "difficulty_range": [0.0, 1.0]},
    **{"max_init_terrain_level": 0, "static_friction": 0.5, "dynamic_friction": 0.4, "restitution": 0.0},
    "sub_terrains": {"flat": {"_target_": "wheelleg_exp.sim.terrain.Flat", "proportion": 1.0}},
}


@pytest.mark.parametrize(("standing", "expected"), [(0.0, [2, 0, 1, 1]), (1.0, [3, 0, 2, 2])])
def test_a_second_reset_before_any_motion_sends_robots_down(start_env, standing, expected):
    command = SPEED | {"rel_standing_envs": standing}
    env = start_env(scene={"terrain": TILES}, commands={"v": command}, curriculum={"c": LEVELS_BY_SPEED})
    env.step(STILL)
    terrain, none = env.scene.terrain, torch.zeros(4, dtype=torch.bool)
    terrain.terrain_levels[:] = T([3, 0, 2, 2])
    terrain.update_env_origins(torch.arange(4), none, none)
    places = env.scene.env_origins + T([0.0, 0.0, 0.5])
    env.scene.robot.write_root_pose_to_sim(torch.cat((places, T([[1.0, 0.0, 0.0, 0.0]] * 4)), dim=1), torch.arange(4))
    env.reset()
    assert terrain.terrain_levels.tolist() == expected


LEVELS = {
    "_target_": C + "lin_vel_cmd_levels",
    "reward_term_name": "alive",
    "command_name": "v",
    "limit_ranges": {"lin_vel_x": [-0.25, 0.55], "lin_vel_y": [-0.1, 0.1]},
    "step": 0.1,
}


def test_commands_grow_once_a_longest_episode_while_they_are_followed(one):
    """A perfect robot lives 100 steps. 96 steps exceed the threshold, and the mean of the later episodes does not."""
    env = one(**LEVELS)
    v = env.command_manager.get_term("v")
    _pass(env, 96)
    assert v.ranges["lin_vel_x"] == [-0.2, 0.3]
    run(env, 96)
    _, extras = env.reset()
    assert v.ranges == {"lin_vel_x": [-0.25, 0.4], "lin_vel_y": [-0.1, 0.1], "ang_vel_z": [-1.0, 1.0]}
    assert extras["log"]["Curriculum/c/lin_vel_x"] == 0.4
    assert float(v.command[:, 0].min()) >= -0.25
    for steps in (50, 50, 50, 10, 92):  # only the last episode is good; the mean over all episodes is compared
        _pass(env, steps)
    assert v.ranges["lin_vel_x"] == [-0.25, 0.4]


def _modify(address, value, *, term=True, **changes):
    node = {"_target_": C + ("modify_term_cfg" if term else "modify_env_param"), "address": address}
    node |= {"modify_fn": "wheelleg_exp.mdp.schedules.override_value"}
    return node | {"modify_params": {"value": value, "num_steps": 2}} | changes


def _reward(env, name):
    return env.reward_manager.get_term_cfg(name)


def _observed(env):
    return env.observation_manager.terms("policy")["q"].term


def _ranges(env):
    return env.command_manager.get_term("v").ranges


def _push(env):
    return env.event_manager.get_term_cfg("push")


PLACES = [
    (True, "rewards.alive.weight", 5.0, lambda env: _reward(env, "alive").fields["weight"]),
    (True, "rewards.low.target_height", 0.3, lambda env: _reward(env, "low").params["target_height"]),
    (True, "rewards.low.params.target_height", 0.3, lambda env: _reward(env, "low").params["target_height"]),
    (True, "commands.v.ranges.lin_vel_x", [0, 2], lambda env: _ranges(env)["lin_vel_x"]),
    (True, "commands.v.ranges.lin_vel_x[1]", 2.0, lambda env: _ranges(env)["lin_vel_x"][1]),
    (True, "commands.v.func.ranges.lin_vel_x[1]", 2.0, lambda env: _ranges(env)["lin_vel_x"][1]),
    (True, "events.push.velocity_range.x[0]", -2.0, lambda env: _push(env).func._low[0].item()),
    (True, "events.push.interval_range_s", [3.0, 4.0], lambda env: _push(env).fields["interval_range_s"]),
    (True, "observations.policy.q.noise.n_max", 0.7, lambda env: _observed(env).fields["noise"].n_max),
    (True, "observations.policy.terms.q.noise.n_max", 0.7, lambda env: _observed(env).fields["noise"].n_max),
    (False, "reward_manager.cfg.alive.weight", 5.0, lambda env: _reward(env, "alive").fields["weight"]),
    (False, "event_manager.cfg.push.params.velocity_range", {"y": [0, 7]}, lambda env: _push(env).func._high),
    (True, "actions.axles.scale", 0.5, lambda env: env.action_manager.get_term("axles")._scale),
    (False, "max_episode_length_s", 7.0, lambda env: env.max_episode_length_s),
]
MEANT = {"actions.axles.scale": [0.5, 0.5], "event_manager.cfg.push.params.velocity_range": [0, 7, 0, 0, 0, 0]}


def _plain(value):
    return value.tolist() if isinstance(value, torch.Tensor) else value


@pytest.mark.parametrize(("term", "place", "value", "read"), PLACES, ids=[p[1] for p in PLACES])
def test_a_value_changes_at_its_address_and_is_saved(one, term, place, value, read):
    """A value changes after more than ``num_steps``. Loading a state restores the changed or the original value."""
    first = one(**_modify(place, value, term=term))
    first.reset()
    before, early = _plain(read(first)), first.state_dict()
    wanted = MEANT.get(place, value)
    assert wanted != before
    _pass(first, 2)
    assert _plain(read(first)) == before
    logged = _pass(first, 1)
    assert (_plain(read(first)), logged) == (wanted, float(value) if isinstance(value, float) else None)
    second = one(**_modify(place, value, term=term))
    second.load_state_dict(first.state_dict())
    assert _plain(read(second)) == wanted
    first.load_state_dict(early)
    assert _plain(read(first)) == before


def ones(env, env_ids, old_value):
    return torch.ones_like(old_value) if env.common_step_counter else curriculums.modify_env_param.NO_CHANGE


def test_a_tensor_anywhere_below_the_environment_is_saved(one):
    node = {"_target_": C + "modify_env_param", "modify_fn": HERE + "ones"}
    first, second = (one(**node, address="scene.robot.data.default_joint_vel") for _ in range(2))
    first.reset()
    early = first.state_dict()
    assert _pass(first) is None
    second.load_state_dict(first.state_dict())
    assert (second.scene.robot.data.default_joint_vel == 1.0).all()
    first.load_state_dict(early)
    assert (first.scene.robot.data.default_joint_vel == 0.0).all()


def test_a_changed_argument_does_not_replace_the_state_of_a_term(one):
    env = one(**_modify("commands.v.resampling_time_range", [7.0, 7.0]))
    v = env.command_manager.get_term("v")
    env.reset()
    v.ranges["lin_vel_x"], tensor = [5.0, 6.0], v.time_left
    run(env, 3)
    env.reset(env_ids=T([0]))
    assert v.time_left is tensor
    assert (v.time_left.tolist(), v.ranges["lin_vel_x"]) == (pytest.approx([7.0, 0.94, 0.94, 0.94]), [5.0, 6.0])
    assert 5.0 <= float(v.command[0, 0]) <= 6.0  # drawn from the new range


def test_an_argument_of_a_wrong_type_is_rejected(one):
    env = one(**_modify("actions.axles.scale", "fast"))
    with pytest.raises(ConfigError) as caught:
        _pass(env, 3)
    assert caught.value.key == "env.actions.axles.scale"


def test_a_tuple_is_replaced_by_a_changed_copy():
    holder = SimpleNamespace(pairs=[(1.0, 2.0), (3.0, 4.0)])
    config_address.write(holder, config_address.parse("pairs[1][0]"), 9.0)
    assert holder.pairs == [(1.0, 2.0), (9.0, 4.0)]


def test_a_user_defined_function_gets_the_current_value(one):
    env = one(**_modify("rewards.alive.weight", None, modify_fn=HERE + "later", modify_params={"add": 2}))
    assert (env.reset()[1]["log"]["Curriculum/c"], [_pass(env), _pass(env)]) == (1.0, [3.0, 5.0])


@pytest.mark.parametrize(
    ("node", "key", "nearest"),
    [
        (_modify("rewards.alife.weight", 1.0), "address", "alive"),
        (_modify("reward.alive.weight", 1.0), "address", "rewards"),
        (_modify("rewards.low.target_hight", 1.0), "address", "target_height"),
        (_modify("commands.v.ranges.lin_vel_x[2]", 1.0), "address", None),
        (_modify("commands.v.ranges.ang_vel", 1.0), "address", "ang_vel_z"),
        (_modify("rewards..weight", 1.0), "address", None),
        (_modify("events.push.mode", "reset"), "address", None),
        (_modify("max_episode_lenght_s", 1.0, term=False), "address", "max_episode_length_s"),
        (_modify("rewards.alive.weight", 1.0, modify_params={"valu": 1.0, "num_steps": 1}), "modify_params", None),
        (_modify("rewards.alive.weight", 1.0, modify_fn="os.getcwd"), "modify_fn._target_", None),
        (_modify("rewards.alive.weight", 1.0, modify_fn=3), "modify_fn", None),
        (LEVELS | {"limit_ranges": {"lin_vel_z": [-1.0, 1.0]}}, "limit_ranges.lin_vel_z", "lin_vel_y"),
        (LEVELS | {"limit_ranges": {"lin_vel_x": [-0.1, 1.0]}}, "limit_ranges.lin_vel_x", None),
    ],
)
def test_wrong_settings_are_rejected_when_the_environment_is_built(one, node, key, nearest):
    with pytest.raises(ConfigError) as caught:
        one(**node)
    assert (caught.value.key, caught.value.nearest) == (f"env.curriculum.c.{key}", nearest)


@pytest.mark.parametrize(("step", "share"), [(0, 0.0), (10, 0.0), (15, 0.25), (30, 1.0), (99, 1.0)])
def test_linear(step, share):
    env = SimpleNamespace(common_step_counter=step)
    got = schedules.linear(env, None, None, {"x": [0.0, 1.0]}, {"x": [4.0, -1.0]}, num_steps=20, first_step=10)
    assert got == {"x": [4.0 * share, 1.0 - 2.0 * share]}
    assert math.isclose(schedules.linear(env, None, None, 1.0, 2.0, num_steps=20, first_step=10), 1.0 + share)
    assert schedules.linear(env, None, None, 1.0, 2.0, num_steps=0, first_step=10) == (2.0 if step > 10 else 1.0)
