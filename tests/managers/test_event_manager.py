"""When events run."""

import pytest
import torch

from managers import spies
from wheelleg_exp.managers.streams import Streams

STILL = torch.zeros(4, 4)


def _event(mode, **fields):
    return {"_target_": spies.HERE + "noted", "mode": mode, **fields}


def _interval(low, high=None, **fields):
    return _event("interval", interval_range_s=[low, low if high is None else high], **fields)


def _run(env, steps):
    for _ in range(steps):
        env.step(STILL)
    return [step for _, step, _ in spies.LOG]


@pytest.mark.parametrize(
    ("interval", "fields", "count", "steps"),
    [((0.05,), {}, 12, [3, 6, 9, 12]), ((0.2, 0.4), {"episode_length_s": 0.2}, 200, [])],
)
def test_an_interval_event_fires_when_its_time_is_up_before_the_episode_ends(start_env, interval, fields, count, steps):
    """A control step is 0.02 s. An interval starts from zero, without the excess of the previous interval."""
    assert _run(start_env(events={"e": _interval(*interval)}, **fields), count) == steps


def test_timers_are_redrawn_at_an_environments_reset(start_env):
    env = start_env(events={"e": _interval(0.05)})
    _run(env, 2)
    env.reset(env_ids=torch.tensor([1]))
    _run(env, 3)
    assert spies.LOG == [("event", 3, [0, 2, 3]), ("event", 5, [1])]


def test_timers_lose_a_control_step_at_an_automatic_reset(start_env):
    """The reset happens before the interval events of the same step."""
    env = start_env(events={"e": _interval(0.05)}, episode_length_s=0.02)
    env.step(STILL)
    torch.testing.assert_close(env.event_manager._time_left["e"], torch.full((4,), 0.03))


def test_each_timer_draws_from_its_own_stream(start_env):
    """Timers are drawn at the construction, at the first reset, and when they expire."""
    env = start_env(events={"a": _interval(1.0, 3.0), "b": _interval(0.03, 0.05)}, seed=5)
    for name, low, high in (("a", 1.0, 3.0), ("b", 0.03, 0.05)):
        stream = Streams(5).get(f"env.events.{name}.interval")
        torch.rand(4, generator=stream)
        second = low + (high - low) * torch.rand(4, generator=stream)
        torch.testing.assert_close(env.event_manager._time_left[name], second)
    third = low + (high - low) * torch.rand(4, generator=stream)
    _run(env, 2)
    expired = second < 0.04
    assert 0 < expired.sum() < 4
    torch.testing.assert_close(env.event_manager._time_left["b"][expired], third[: expired.sum()])


def test_a_global_timer_fires_for_all_at_once_and_is_not_redrawn_at_resets(start_env):
    env = start_env(events={"e": _interval(0.05, is_global_time=True)})
    _run(env, 2)
    env.reset()
    _run(env, 1)
    assert spies.LOG == [("event", 3, None)]
    assert _run(env, 6) == [3, 6, 9]


def test_the_new_interval_is_drawn_before_the_event_runs(make_env):
    env = make_env(events={"e": _interval(0.04)})
    seen = []
    env.event_manager._terms["e"].func = lambda e, ids: seen.append(e.event_manager._time_left["e"].clone())
    for _ in range(2):
        env.event_manager.advance_timers(0.02)
        env.event_manager.apply_due(0.02)
    torch.testing.assert_close(seen[0], torch.full((4,), 0.04))


@pytest.mark.parametrize(("mode", "ids", "log"), [("reset", [[0, 2]], [0, 2]), ("startup", [None, None], None)])
def test_a_reset_event_runs_for_the_environments_that_reset_and_startup_once_for_all(make_env, mode, ids, log):
    env = make_env(events={"e": _event(mode)})
    for each in ids:
        env.reset(env_ids=None if each is None else torch.tensor(each))
    (logged,) = spies.LOG
    assert logged == ("event", 0, log)


def test_a_reset_event_waits_its_least_number_of_control_steps(make_env):
    env = make_env(events={"e": _event("reset", min_step_count_between_reset=5)})
    for step in range(10):
        env.reset(env_ids=torch.tensor([0, 1] if step == 9 else [1]))
        env.step(STILL)
    assert spies.LOG == [("event", 0, [1]), ("event", 5, [1]), ("event", 9, [0])]


def test_a_user_defined_mode_runs_only_when_applied(start_env):
    env = start_env(events={"e": _event("my_mode")})
    _run(env, 3)
    with pytest.warns(UserWarning, match=r"'my_mod'.*'my_mode'"):
        env.apply_event("my_mod")
    env.event_manager.apply("startup")
    assert spies.LOG == []
    env.event_manager.apply("my_mode", torch.tensor([3]))
    env.apply_event("my_mode")
    assert (spies.LOG, env.event_manager.available_modes) == ([("event", 3, [3]), ("event", 3, None)], ["my_mode"])


def test_events_of_a_mode_run_in_the_order_of_the_config(make_env):
    make_env(events={name: _event("reset", key=name) for name in ("zeta", "alpha", "mid")}).reset()
    assert [key for key, _, _ in spies.LOG] == ["zeta", "alpha", "mid"]


def test_counters_exist_before_managers_and_changes_before_the_start_are_compiled(make_env):
    seen = {}

    def heavier(env, env_ids):
        seen.update(vars(env))
        env.scene.spec.body("base").mass = 7.0

    spies.VALUES["k"] = heavier
    env = make_env(events={"e": {"_target_": spies.HERE + "writes", "mode": "prestartup", "key": "k"}})
    assert (seen["common_step_counter"], seen["episode_length_buf"].tolist()) == (0, [0] * 4)
    assert {name for name in seen if name.endswith("_manager")} <= {"scene_manager", "event_manager"}
    assert float(env.scene.model.body("base").mass[0]) == 7.0


def test_a_class_that_runs_before_the_start_is_never_reset(make_env):
    node = {"_target_": spies.HERE + "SpyEvent"}
    env = make_env(events={mode: {**node, "mode": mode, "name": mode} for mode in ("prestartup", "startup")})
    assert spies.LOG[:2] == ["event prestartup made", "event prestartup None"]
    spies.LOG.clear()
    env.reset()
    assert spies.LOG == ["event startup reset [0, 1, 2, 3]"]


@pytest.mark.parametrize(("mode", "words"), [("interval", "interval"), ("reset", "step_count")])
def test_modes_that_cannot_be_applied_by_name_are_rejected(make_env, mode, words):
    env = make_env(events={"e": _interval(1.0) if mode == "interval" else _event(mode)})
    with pytest.raises(ValueError, match=words):
        env.event_manager.apply(mode)
