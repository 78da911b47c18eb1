"""Observations: the order of processing, histories, layout, and reading without a trace."""

import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError

O = "wheelleg_exp.mdp.observations."
N = "wheelleg_exp.mdp.noise."
M = "wheelleg_exp.mdp.modifiers."
UNFLATTENED = {"flatten_history_dim": False, "concatenate_terms": False}


def _value(key="x", **fields):
    spies.VALUES.setdefault(key, 1.0)
    return {"_target_": spies.HERE + "column", "key": key, **fields}


def _env(make_env, terms, **group):
    return make_env(observations={"policy": {"terms": terms, **group}})


def _read(env):
    return env.observation_manager.compute()["policy"]


def _series(env, key, *values):
    out = None
    for number in values:
        spies.VALUES[key] = number
        out = _read(env)
    return out


def test_a_value_is_modified_in_order_then_noised_clipped_and_scaled(make_env):
    settings = (("Bias", {"value": 1.0}), ("Scale", {"multiplier": 3.0}), ("Clip", {"bounds": [0.0, 8.0]}))
    fields = {"modifiers": [{"_target_": M + name, **fields} for name, fields in settings], "clip": [-100.0, 8.25]}
    node = _value(noise={"_target_": N + "ConstantNoise", "bias": 0.5}, scale=10.0, **fields)
    env = _env(make_env, {"x": node}, enable_corruption=True)
    assert float(_series(env, "x", 1.0)[0]) == 65.0  # ((1 + 1) * 3 + .5) * 10
    assert float(_series(env, "x", 2.0)[0]) == 82.5  # 9 is clipped to 8 before the noise, and 8.5 to 8.25 after it


@pytest.mark.parametrize("group", [{"enable_corruption": False}, {}])  # off by default
def test_without_corruption_noise_is_off_and_modifiers_stay(make_env, group):
    noise, modifiers = {"_target_": N + "ConstantNoise"}, [{"_target_": M + "Scale", "multiplier": 2.0}]
    node = _value(noise=noise | {"bias": 100.0}, modifiers=modifiers)
    assert float(_series(_env(make_env, {"x": node}, **group), "x", 3.0)[0]) == 6.0


def test_a_scale_can_have_one_number_per_column(make_env):
    scale = [1.0, 2.0, 3.0, 4.0]
    env = _env(make_env, {"q": {"_target_": O + "joint_pos", "scale": scale}})
    torch.testing.assert_close(_read(env), env.scene.robot.data.joint_pos * torch.tensor(scale))
    with pytest.raises(ConfigError, match="width 4"):
        _env(make_env, {"q": {"_target_": O + "joint_pos", "scale": [1.0, 2.0]}})


def test_the_first_sample_after_a_reset_fills_the_history_of_its_environments(make_env):
    env = _env(make_env, {"x": _value()}, history_length=3)
    assert (_series(env, "x", 5.0)[0].tolist(), _series(env, "x", 6.0)[0].tolist()) == ([5, 5, 5], [5, 5, 6])
    assert _series(env, "x", 1.0, 2.0, 3.0, 4.0)[0].tolist() == [2, 3, 4]
    env.observation_manager.reset(torch.tensor([1]))
    out = _series(env, "x", 9.0)
    assert (out[1].tolist(), out[0].tolist()) == ([9, 9, 9], [3, 4, 9])


def test_histories_are_flattened_by_term_and_then_by_sample_and_hold_scaled_samples(make_env):
    env = _env(make_env, {"x": _value("x", scale=2.0), "q": {"_target_": O + "joint_pos"}}, history_length=2)
    robot, frames = env.scene.robot, []
    for x in (1.0, 2.0, 3.0):
        robot.write_joint_state_to_sim(torch.randn(4, 4), torch.zeros(4, 4), env_ids=torch.arange(4))
        frames.append(robot.data.joint_pos.clone())
        out = _series(env, "x", x)
    assert torch.equal(out, torch.cat((torch.tensor([[4.0, 6.0]] * 4), *frames[1:]), dim=1))


def test_unflattened_histories_have_a_time_axis(make_env):
    env = _env(make_env, {"x": _value("x"), "y": _value("y")}, history_length=2, flatten_history_dim=False)
    spies.VALUES["y"] = 7.0
    out = _series(env, "x", 1.0, 2.0)
    assert (out.shape, out[0].tolist()) == ((4, 2, 2), [[1, 7], [2, 7]])
    assert env.observation_manager.group_obs_dim["policy"] == (2, 2)


@pytest.mark.parametrize(
    ("term", "group", "dims"),
    [
        ({}, {}, [(4,), (1,)]),
        ({}, {"history_length": 2}, [(2,), (2,)]),
        ({}, {"history_length": 0}, [(1,), (1,)]),
        ({"flatten_history_dim": True}, UNFLATTENED, [(4,), (1,)]),
        ({"flatten_history_dim": True}, UNFLATTENED | {"history_length": 2}, [(2, 1), (2, 1)]),
    ],
)
def test_a_groups_history_overrides_length_and_flattening_of_its_terms(make_env, term, group, dims):
    env = _env(make_env, {"x": _value("x", history_length=4, **term), "y": _value("y")}, **group)
    assert env.observation_manager.group_obs_term_dim["policy"] == dims


def test_the_last_observation_can_be_read_term_by_term(make_env):
    terms = {"x": _value("x"), "y": _value("y")}
    env = make_env(observations={"a": {"terms": terms, "history_length": 2}, "b": {"terms": {"y": _value("y")}}})
    spies.VALUES.update(x=torch.tensor([1.0, 2.0, 3.0, 4.0]), y=7.0)
    env.observation_manager.compute()
    found = env.observation_manager.get_active_iterable_terms(2)
    assert found == [("a-x", [3.0, 3.0]), ("a-y", [7.0, 7.0]), ("b-y", [7.0])]


def test_terms_and_groups_follow_the_order_of_the_config(make_env):
    env = make_env(observations={g: {"terms": {t: _value(t) for t in ("z", "a", "m")}} for g in ("late", "early")})
    spies.VALUES.update(z=1.0, a=2.0, m=3.0)
    out = env.observation_manager.compute()
    assert (list(out), out["late"][0].tolist()) == (["late", "early"], [1, 2, 3])
    assert env.observation_manager.active_terms["late"] == ["z", "a", "m"]
    assert env.observation_manager.term_slices("late") == {"z": slice(0, 1), "a": slice(1, 2), "m": slice(2, 3)}


def test_an_observation_that_is_separated_by_term_does_not_change_later(start_env):
    action = {"_target_": O + "last_action"}
    terms = {"action": action, "q": {"_target_": O + "joint_pos"}, "past": action | {"history_length": 2}}
    env = start_env(observations={"policy": {"terms": terms, "concatenate_terms": False}})
    assert env.observation_manager.group_obs_dim["policy"] == [(4,), (4,), (8,)]
    first, *_ = env.step(torch.ones(4, 4))
    copied = {k: v.clone() for k, v in first["policy"].items()}
    assert {k: v.shape[1] for k, v in copied.items()} == {"action": 4, "q": 4, "past": 8}
    env.step(torch.full((4, 4), 2.0))
    env.reset()
    for name, value in copied.items():
        assert torch.equal(first["policy"][name], value), name


BIAS = {"noise_cfg": {"_target_": N + "GaussianNoise", "std": 0.1}}
BIAS["bias_noise_cfg"] = {"_target_": N + "UniformNoise", "operation": "abs"}


def _busy_terms():
    return {
        "filter": _value(modifiers=[{"_target_": M + "Integrator", "dt": 0.1}]),
        "count": {"_target_": spies.HERE + "CountingObservation"},
        "drawn": {"_target_": spies.HERE + "drawing_observation"},
        "noisy": _value(noise={"_target_": N + "UniformNoise", "n_min": -1.0, "n_max": 1.0}),
        "biased": _value(noise={"_target_": N + "NoiseModelWithAdditiveBias", **BIAS}),
    }


def test_a_peek_and_the_construction_change_nothing_and_draw_nothing(make_env):
    plain, looked = (_env(make_env, _busy_terms(), history_length=3, enable_corruption=True) for _ in range(2))
    path = "env.observations.policy.terms.noisy.noise"
    assert torch.equal(plain.streams.get(path).get_state(), type(plain.streams)(0).get(path).get_state())
    for k in range(5):
        spies.VALUES["x"] = float(k)
        looked.observation_manager.peek()
        expected, got = _read(plain), _read(looked)
        looked.observation_manager.peek()
        assert torch.equal(expected, got)


def test_a_peek_is_the_coming_observation_without_noise(make_env):
    terms = {"x": _value("x"), "noisy": _value("y", noise={"_target_": N + "ConstantNoise", "bias": 9.0})}
    env = _env(make_env, terms, history_length=2, enable_corruption=True)
    spies.VALUES.update(x=1.0, y=5.0)
    assert env.observation_manager.peek()["policy"][0].tolist() == [1, 1, 5, 5]  # an empty history
    _read(env)
    spies.VALUES.update(x=2.0)
    assert env.observation_manager.peek()["policy"][0].tolist() == [1, 2, 14, 5]


def test_a_reset_restarts_terms_and_modifiers_and_redraws_biases_for_its_environments(make_env):
    terms = {name: term for name, term in _busy_terms().items() if name in ("filter", "biased", "count")}
    terms["biased"]["noise"]["noise_cfg"] = {"_target_": N + "ConstantNoise"}
    env = _env(make_env, terms, enable_corruption=True)
    spies.VALUES["x"] = 2.0
    first = _read(env).clone()
    second = _read(env).clone()
    torch.testing.assert_close(second[:, 0], first[:, 0] + 0.2)  # 2.0 for 0.1 s
    assert torch.equal(second[:, 2], first[:, 2])
    env.observation_manager.reset(torch.tensor([2]))
    third = _read(env)
    torch.testing.assert_close(third[:, 0], first[:, 0] + torch.tensor([0.4, 0.4, 0.0, 0.4]))
    assert (first[:, 1].tolist(), third[:, 1].tolist()) == ([1, 1, 1, 1], [3, 3, 1, 3])
    assert (third[:, 2] == first[:, 2]).tolist() == [True, True, False, True]


@pytest.mark.parametrize(
    ("key", "fields", "expected"),
    [
        ("x", {}, ("x", 2.0, 2.0)),
        ("y", {}, ("xy", 2.0, 5.0)),
        ("x", {"modifiers": [{"_target_": M + "Bias", "value": 1.0}], "scale": 10.0}, ("x", 2.0, 30.0)),
    ],
)
def test_a_function_of_two_groups_is_called_once_a_step_and_processed_by_each(make_env, key, fields, expected):
    nodes = {"policy": {"terms": {"x": _value("x")}}, "critic": {"terms": {"y": _value(key, **fields)}}}
    env, called = make_env(observations=nodes), []
    spies.VALUES.update(x=lambda _: called.append("x") or 2.0, y=lambda _: called.append("y") or 5.0)
    observed = env.observation_manager.compute()
    assert ("".join(called), float(observed["policy"][0]), float(observed["critic"][0])) == expected


def _policy_and_critic(make_env):
    policy = {"a": _value("x"), "b": _value("y")}
    groups = {"policy": policy, "critic": policy | {"c": _value("z")}}
    return make_env(observations={name: {"terms": terms, "history_length": 3} for name, terms in groups.items()})


def _observed(env, x, y, z, w=0.0):
    spies.VALUES.update(x=x, y=y, z=z, w=w)
    observed = env.observation_manager.compute()
    return observed["policy"][0].tolist(), observed["critic"][0].tolist()


def test_a_group_that_is_a_prefix_of_another_has_the_same_rows(make_env):
    env = _policy_and_critic(make_env)
    assert _observed(env, 1.0, 2.0, 3.0) == ([1, 1, 1, 2, 2, 2], [1, 1, 1, 2, 2, 2, 3, 3, 3])
    assert _observed(env, 4.0, 5.0, 6.0) == ([1, 1, 4, 2, 2, 5], [1, 1, 4, 2, 2, 5, 3, 3, 6])
    spies.VALUES.update(x=7.0, y=8.0, z=9.0)
    peeked = env.observation_manager.peek()
    assert peeked["policy"][0].tolist() == [1, 4, 7, 2, 5, 8]
    assert peeked["critic"][0].tolist() == [1, 4, 7, 2, 5, 8, 3, 6, 9]
    for value in env.observation_manager.compute().values():
        value.fill_(99.0)
    assert _observed(env, 0.0, 0.0, 0.0) == ([4, 7, 0, 5, 8, 0], [4, 7, 0, 5, 8, 0, 6, 9, 0])


def test_a_group_is_computed_separately_once_a_parameter_of_the_other_changes(make_env):
    env = _policy_and_critic(make_env)
    _observed(env, 1.0, 2.0, 3.0)
    env.observation_manager.terms("critic")["a"].term.params["key"] = "w"
    assert _observed(env, 4.0, 5.0, 6.0, 7.0) == ([1, 1, 4, 2, 2, 5], [1, 1, 7, 2, 2, 5, 3, 3, 6])
    again = _policy_and_critic(make_env)
    again.load_state_dict(env.state_dict())
    for one in (env, again):
        assert _observed(one, 8.0, 9.0, 10.0, 11.0) == ([1, 4, 8, 2, 5, 9], [1, 7, 11, 2, 5, 9, 3, 6, 10])
