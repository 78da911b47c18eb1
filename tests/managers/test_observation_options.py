"""Observations with delays, with histories ordered by step, along other dimensions, and of images."""

import pytest
import torch

from managers import spies
from managers.test_observation_manager import _series, _value
from wheelleg_exp.errors import ConfigError

O = "wheelleg_exp.mdp.observations."
M = "wheelleg_exp.mdp.modifiers."
STILL = torch.zeros(4, 4)
PICTURE = {"_target_": "managers.test_observation_options.picture", "key": "a"}


def _env(make_env, terms, *, num_envs=4, **group):
    return make_env(observations={"policy": {"terms": terms, **group}}, num_envs=num_envs)


def _counting(start_env, **fields):
    counted = {"n": 0}
    spies.VALUES["x"] = lambda env: torch.full((env.num_envs,), float(counted["n"]))
    num_envs = fields.pop("num_envs", 4)
    env = _env(start_env, {"x": _value(**fields)}, num_envs=num_envs)
    step = env.scene.sim.step

    def counting():
        counted["n"] += 1
        step()

    env.scene.sim.step = counting
    return env


def test_a_delay_counts_physics_steps_and_not_control_steps(make_env):
    """A control step has two physics steps, so a delay of three falls between two observations."""
    env = _counting(make_env, delay=[3, 3])
    seen = [float(env.reset()[0]["policy"][0])] + [float(env.step(STILL)[0]["policy"][0]) for _ in range(4)]
    assert seen == [0, 0, 1, 3, 5]  # the counts 0, 2, 4, 6, and 8, three steps late


def test_without_a_delay_nothing_is_stored(start_env):
    for delay in (None, [0, 0]):
        env = _counting(start_env, delay=delay)
        assert float(env.step(STILL)[0]["policy"][0]) == 2
        assert "delay" not in env.observation_manager.state_dict()["groups"]["policy"]["x"]
        assert "env.observations.policy.terms.x.delay" not in env.streams.state_dict()["generators"]


def test_delays_are_drawn_at_the_reset_of_an_environment(start_env):
    env = _counting(start_env, delay=[1, 3], num_envs=300)
    (term,) = env.observation_manager.terms("policy").values()
    lags = term.delay.lag
    before = lags.clone()
    assert sorted(before.unique().tolist()) == [1, 2, 3]
    for _ in range(3):
        shown = env.step(torch.zeros(300, 4))[0]["policy"][:, 0]
    assert torch.equal(shown, 6.0 - before)
    env.reset(env_ids=torch.arange(100))
    assert torch.equal(lags[100:], before[100:])
    assert not torch.equal(lags[:100], before[:100])
    shown = env.observation_manager.obs_buf["policy"][:, 0]
    assert (shown[:100] == 6).all()  # a new episode does not observe the last episode
    assert torch.equal(shown[100:], 6.0 - before[100:])


def test_a_delayed_value_is_modified_clipped_scaled_and_stored_on_arrival(start_env):
    bias = {"_target_": M + "Bias", "value": 10.0}
    env = _counting(start_env, delay=[2, 2], modifiers=[bias], clip=[0.0, 13.0], scale=2.0, history_length=2)
    for _ in range(3):
        shown = env.step(STILL)[0]["policy"][0].tolist()
    assert shown == [24.0, 26.0]  # (2 + 10) * 2, and 4 + 10 clipped to 13, times 2


def test_a_peek_at_a_delayed_value_changes_nothing(start_env):
    env = _counting(start_env, delay=[3, 3])
    for expected, ahead in ((0, 0), (1, 2), (3, 4), (5, 6)):
        assert env.step(STILL)[0]["policy"][0].item() == expected
        for _ in range(3):  # a peek acts like one more sample
            assert env.observation_manager.peek()["policy"][0].item() == ahead


def test_two_groups_of_one_term_can_have_different_delays(make_env):
    node = {"_target_": O + "joint_pos"}
    env = make_env(observations={"late": {"terms": {"q": {**node, "delay": [2, 2]}}}, "now": {"terms": {"q": node}}})
    before, _ = env.reset()
    after, *_ = env.step(torch.ones(4, 4))
    assert torch.equal(after["late"], before["now"])
    assert not torch.equal(after["now"], before["now"])


def test_histories_can_be_ordered_step_by_step(make_env):
    terms = {"x": _value("x"), "q": {"_target_": O + "joint_pos"}}
    env = _env(make_env, terms, history_length=2, history_order="time")
    manager, robot = env.observation_manager, env.scene.robot
    assert manager.group_obs_dim["policy"] == (10,)
    robot.write_joint_state_to_sim(torch.arange(4.0).expand(4, 4), STILL, env_ids=torch.arange(4))
    _series(env, "x", 7.0)
    robot.write_joint_state_to_sim(10 + torch.arange(4.0).expand(4, 4), STILL, env_ids=torch.arange(4))
    expected = [7, 0, 1, 2, 3, 8, 10, 11, 12, 13]
    spies.VALUES["x"] = 8.0
    assert manager.peek()["policy"][0].tolist() == expected
    out = manager.compute()["policy"]
    assert out[0].tolist() == expected
    assert {n: v[0].tolist() for n, v in manager.split("policy", out).items()} == {
        "x": [7, 8],
        "q": [0, 1, 2, 3, 10, 11, 12, 13],
    }
    assert manager.term_parts("policy")["q"] == [slice(1, 5), slice(6, 10)]
    with pytest.raises(ValueError, match="history_order 'time'"):
        manager.term_slices("policy")
    manager.reset(torch.tensor([1]))
    assert _series(env, "x", 9.0)[1].tolist() == [9, 10, 11, 12, 13] * 2


@pytest.mark.parametrize(
    ("group", "key", "words"),
    [
        *(({"terms": {"x": {"delay": delay}}}, "terms.x.delay", None) for delay in ([2, 1], [-1, 2], [0.5, 1], 3)),
        ({"terms": {}}, "terms", None),
        ({"histroy_length": 2}, "histroy_length", None),
        ({"history_order": "time"}, "history_order", None),
        ({"history_order": "time", "history_length": 2, "flatten_history_dim": False}, "history_order", None),
        ({"history_order": "time", "concatenate_terms": False}, "history_order", None),
        ({"concatenate_dim": 1}, "concatenate_dim", "from -1 to 0"),
        ({"terms": {"x": {}, "a": PICTURE}}, "terms", r"x \(1,\), a \(2, 3, 1\).*value\.flatten\(1\)"),
    ],
)
def test_wrong_options_name_their_key(make_env, group, key, words):
    spies.VALUES["a"] = 1.0
    terms = {name: _value() | node for name, node in group.pop("terms", {"x": {}}).items()}
    with pytest.raises(ConfigError, match=words) as caught:
        _env(make_env, terms, **group)
    assert caught.value.key == f"env.observations.policy.{key}"


def test_terms_can_be_joined_along_their_steps(make_env):
    terms = {"x": _value("x"), "y": _value("y")}
    env = _env(make_env, terms, history_length=3, flatten_history_dim=False, concatenate_dim=0)
    spies.VALUES["y"] = 5.0
    out = _series(env, "x", 1.0, 2.0)
    assert (out.shape, out[0].flatten().tolist()) == ((4, 6, 1), [1, 1, 2, 5, 5, 5])
    manager = env.observation_manager
    assert manager.group_obs_dim["policy"] == (6, 1)
    assert manager.split("policy", out)["y"][0].tolist() == [[5], [5], [5]]


def picture(env, key):
    return spies.VALUES[key] * torch.arange(6.0).view(2, 3, 1).expand(env.num_envs, 2, 3, 1)


def test_pictures_are_joined_like_isaac_labs(make_env):
    spies.VALUES.update(a=1.0, b=10.0)
    terms = {"a": PICTURE | {"clip": [0.0, 4.0]}, "b": PICTURE | {"key": "b", "scale": 2.0}}
    env = _env(make_env, terms)
    out = env.observation_manager.compute()["policy"]
    assert out.shape == (4, 2, 3, 2)  # channels, by default
    assert out[0, 1, 2].tolist() == [4.0, 100.0]
    env = _env(make_env, terms, concatenate_dim=0)
    assert env.observation_manager.compute()["policy"].shape == (4, 4, 3, 1)
    assert env.observation_manager.group_obs_dim["policy"] == (4, 3, 1)


def test_pictures_have_histories(make_env):
    spies.VALUES["a"] = 1.0
    for flatten, shape in ((False, (3, 2, 3, 1)), (True, (18,))):
        env = _env(make_env, {"a": PICTURE}, history_length=3, flatten_history_dim=flatten)
        for number in (1.0, 2.0):
            spies.VALUES["a"] = number
            out = env.observation_manager.compute()["policy"]
        assert (out.shape, out.view(4, 3, 6)[0, :, 5].tolist()) == ((4, *shape), [5, 5, 10])
