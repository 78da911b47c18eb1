"""Observations: the order of processing, histories, layout, reading without a trace, delays, and pictures."""

import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError

O = "wheelleg_exp.mdp.observations."
N = "wheelleg_exp.mdp.noise."
M = "wheelleg_exp.mdp.modifiers."
STILL = torch.zeros(4, 4)
PICTURE = {"_target_": "managers.test_observation_manager.picture", "key": "a"}
UNFLATTENED = {"flatten_history_dim": False, "concatenate_terms": False}


def _value(key="x", **fields):
    spies.VALUES.setdefault(key, 1.0)
    return {"_target_": spies.HERE + "column", "key": key, **fields}


def _env(make_env, terms, *, num_envs=4, **group):
    return make_env(observations={"policy": {"terms": terms, **group}}, num_envs=num_envs)


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


def test_a_later_term_can_reuse_the_tensor_of_an_earlier_term(make_env):
    groups = {"a": ["x", "y"], "b": ["z"], "c": ["w"]}
    nodes = {name: {"terms": {k: _value(k) for k in keys}, "concatenate_terms": False} for name, keys in groups.items()}
    nodes["b"]["concatenate_terms"] = nodes["c"]["concatenate_terms"] = True
    env, tensor = make_env(observations=nodes), torch.zeros(4)
    spies.VALUES.update({key: lambda _, i=i: tensor.fill_(float(i)) for i, key in enumerate("xyzw")})
    found = env.observation_manager.compute()
    assert [float(value[0]) for value in (*found["a"].values(), found["b"], found["c"])] == [0, 1, 2, 3]


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


# --- delays, histories ordered by step, other dimensions, and pictures ---


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
