"""Terms written for Isaac Lab in a real environment: bound, called, drawing from their own stream, saved."""

import sys
from types import ModuleType

import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.determinism import no_global_draws

P = "isaaclab.people."
ENTITY = "wheelleg_exp.managers.SceneEntityCfg"
HIPS = {"_target_": ENTITY, "name": "robot", "joint_names": [".*_hip"]}
BODIES = {"_target_": ENTITY, "name": "contact", "body_names": [".*_wheel"]}
REWARDS = {
    "high": {"_target_": P + "height_above", "weight": 2.0, "minimum": 0.1},
    "air": {"_target_": P + "air_time", "weight": 1.0, "threshold": 0.1, "sensor_cfg": BODIES},
    "smooth": {"_target_": P + "Smoothness", "weight": -0.5, "scale": 2.0, "asset_cfg": HIPS},
}
EVENTS = {"jolt": {"_target_": P + "jolt", "mode": "reset", "spread": 0.2}}
ACTIONS = {"torque": {"_target_": P + "TorqueAction", "joint_names": [".*_axle"], "scale": 3.0}}
COMMANDS = {"hop": {"_target_": P + "HopCommand", "resampling_time_range": [0.04, 0.06], "heights": [0.5, 0.7]}}


@pytest.fixture
def make(make_env, monkeypatch):
    from wheelleg_exp.terms import term_binding

    packages = term_binding.allowed_packages()
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: (*packages, "isaaclab"))
    sections = {"rewards": REWARDS, "events": EVENTS, "actions": ACTIONS, "commands": COMMANDS}

    def make(seed=0, **changes):
        return make_env(seed=seed, **{**sections, **changes})

    return make


def lived(env, steps=7):
    env.reset()
    for k in range(steps):
        env.step(torch.full((4, 2), 0.1 * k))
    return env


def test_an_observation_can_have_a_parameter_named_scale(make):
    env = make(observations={"policy": {"terms": {"high": {"_target_": P + "scaled_height", "scale": 3.0}}}})
    seen = env.reset()[0]["policy"]
    torch.testing.assert_close(seen, 3.0 * env.scene.robot.data.root_pos_w[:, 2:3])


def test_a_term_calls_stock_events_that_draw_from_the_terms_own_stream(make):
    def places(seed, **more):
        scatter = {"_target_": P + "scatter", "mode": "reset", "spread": 0.2, "asset_cfg": HIPS}
        place = {"_target_": P + "reset_root_state_uniform", "mode": "reset"}
        place |= {"pose_range": {"y": [0.3, 0.3]}, "velocity_range": {}}
        env = make(seed, events={"place": place, "scatter": scatter, **more})
        with no_global_draws():
            env.reset()
        data = env.scene.robot.data
        moved = data.root_pos_w[:, :1] - env.scene.env_origins[:, :1]
        return torch.cat((moved, data.joint_pos - data.default_joint_pos), dim=1)

    found = places(0)
    assert 0.05 < found[:, :3].abs().max() <= 0.2
    assert found[:, 1:3].std() > 0.01
    assert found[:, 3:].abs().max() < 1e-6
    assert torch.equal(found, places(0, other={**EVENTS["jolt"], "mode": "interval", "interval_range_s": [9.0, 9.0]}))
    assert not torch.equal(found, places(1))


def test_a_module_that_imports_only_a_stock_event_draws_from_its_terms_stream(make, monkeypatch):
    module = ModuleType("isaaclab.only_an_event")
    exec(
        "from wheelleg_exp.isaaclab.envs.mdp import reset_joints_by_offset\n"
        "def shake(env, env_ids, asset_cfg):\n"
        "    reset_joints_by_offset(env, env_ids.tolist(), (0.1, 0.2), (0.0, 0.0), asset_cfg)\n",
        vars(module),
    )
    monkeypatch.setitem(sys.modules, module.__name__, module)
    node = {"_target_": f"{module.__name__}.shake", "mode": "reset", "asset_cfg": HIPS}
    env = make(events={"shake": node})
    with no_global_draws():
        env.reset()
    moved = (env.scene.robot.data.joint_pos - env.scene.robot.data.default_joint_pos)[:, :2]
    assert ((moved >= 0.1) & (moved <= 0.2)).all()


def test_a_class_term_gets_its_config_and_its_parameters(make):
    env = make()
    term = env.reward_manager.get_term_cfg("smooth")
    assert (term.func.seen_weight, term.params["scale"]) == (-0.5, 2.0)
    env.reset()
    env.step(torch.zeros(4, 2))
    first = env.scene.robot.data.joint_vel[:, :2].clone()
    env.step(torch.ones(4, 2))
    change = (env.scene.robot.data.joint_vel[:, :2] - first).square().sum(dim=1)
    torch.testing.assert_close(env.reward_manager.step_reward[2], -0.5 * 2.0 * change)
    term.params["scale"] = 0.0
    env.step(torch.ones(4, 2))
    assert not env.reward_manager.step_reward[2].any()


@pytest.mark.parametrize(
    ("section", "name", "parameter"),
    [("rewards", "high", "minimum"), ("rewards", "smooth", "scale"), ("events", "jolt", "spread")],
)
def test_a_wrong_type_is_reported_although_only_type_checkers_import_the_env(make, section, name, parameter):
    nodes = {"rewards": REWARDS, "events": EVENTS}[section]
    with pytest.raises(ConfigError, match="right type") as caught:
        make(**{section: {name: {**nodes[name], parameter: "abc"}}})
    assert (caught.value.key, caught.value.expected) == (f"env.{section}.{name}.{parameter}", "a number")


def test_an_action_of_its_own_config(make):
    env = make()
    env.reset()
    env.step(torch.tensor([[0.1, 5.0]] * 4))
    assert env.action_manager.get_term("torque").processed_actions[1].tolist() == pytest.approx([0.3, 1.0])
    assert env.scene.robot.data.joint_effort_target[1].tolist() == pytest.approx([0, 0, 0.3, 1.0])


def test_a_command_of_its_own_config(make):
    env = lived(make(), 40)
    command, term = env.command_manager.get_command("hop"), env.command_manager.get_term("hop")
    assert bool(((command >= 0.5) & (command <= 0.7)).all())
    assert len(set(command.flatten().tolist())) == 4
    assert int(term.command_counter.min()) > 5  # 0.8 s have passed, with a draw every 0.04 to 0.06 s
    log = env.command_manager.reset(torch.arange(4))
    assert 0.5 * 40 < float(log["Metrics/hop/asked"]) < 0.7 * 41
    assert not term.metrics["asked"].any()


def test_terms_draw_from_their_own_random_stream(make):
    with no_global_draws():
        first = lived(make(seed=1))
    torch.rand(100)
    again, other = lived(make(seed=1)), lived(make(seed=2))
    alone = lived(make(seed=1, commands={}))
    states = [env.scene.sim.view("qpos") for env in (first, again, other, alone)]
    assert torch.equal(states[0], states[1])
    assert not torch.equal(states[0], states[2])
    assert torch.equal(states[0], states[3])
    assert (first.scene.robot.data.root_pos_w - first.scene.env_origins)[:, 0].std() > 0.01


def test_the_state_of_terms_is_saved(make):
    env, other = lived(make(seed=3), 9), make(seed=3)
    other.load_state_dict(env.state_dict())
    for k in range(60):
        action = torch.full((4, 2), 0.01 * k)
        (_, one, *_), (_, two, *_) = env.step(action), other.step(action)
        assert torch.equal(one, two)
    assert torch.equal(env.scene.sim.state, other.scene.sim.state)


@pytest.mark.parametrize(
    ("section", "name", "change", "message"),
    [
        ("rewards", "smooth", {"scal": 1.0},
         r"rewards.smooth.scal: .* takes no parameter 'scal'.*did you mean 'scale'"),
        ("actions", "torque", {"joint_name": "x"}, r"actions.torque.joint_name: .*did you mean 'joint_names'"),
    ],
)  # fmt: skip
def test_mistakes_are_reported_by_key(make, section, name, change, message):
    nodes = {"rewards": REWARDS, "actions": ACTIONS, "commands": COMMANDS}[section]
    with pytest.raises(ConfigError, match=message):
        make(**{section: {**nodes, name: {**nodes[name], **change}}})
