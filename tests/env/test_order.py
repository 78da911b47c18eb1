"""Test the order of all manager calls during construction, a step, and a reset."""

import pytest
import torch
from managers import spies

S = spies.HERE


@pytest.fixture
def env(make_env, monkeypatch):
    """Return three environments whose managers are spies, with two physics steps per control step."""
    from wheelleg_exp.sim.scene import Scene

    said = {"write_data_to_sim": "write", "update": "update", "show_written": "refresh", "play": "play"}
    for name, word in said.items():
        _log_calls(monkeypatch, Scene, name, word)
    _log_calls(monkeypatch, Scene, "reset", "scene reset", ids=True)
    event = {"_target_": S + "SpyEvent"}
    return make_env(
        num_envs=3,
        scene={"sensors": {}},
        events={
            "on_time": event | {"mode": "interval", "name": "interval", "interval_range_s": [0.02, 0.02]},
            "at_reset": event | {"mode": "reset", "name": "at_reset"},
            "at_start": event | {"mode": "startup", "name": "startup"},
            "before": {"_target_": S + "spy_prestartup", "mode": "prestartup"},
        },
        commands={"c": {"_target_": S + "SpyCommand"}},
        actions={"a": {"_target_": S + "SpyAction"}},
        observations={"policy": {"terms": {"o": {"_target_": S + "SpyObservation"}}}},
        rewards={"r": {"_target_": S + "SpyReward", "weight": 1.0}},
        terminations={"t": {"_target_": S + "SpyTermination"}},
        curriculum={"k": {"_target_": S + "SpyCurriculum"}},
        recorders={"e": {"_target_": S + "SpyRecorder"}},
    )


def _log_calls(monkeypatch, owner, name, said, ids=False):
    original = getattr(owner, name)

    def logged(self, *args):
        spies.LOG.append(f"{said} {args[0].tolist()}" if ids else said)
        return original(self, *args)

    monkeypatch.setattr(owner, name, logged)


def _log_steps(env):
    step = env.scene.sim.step

    def logged():
        spies.LOG.append("physics")
        step()

    env.scene.sim.step = logged
    env.observers.append(lambda: spies.LOG.append("observer"))


def _calls(function):
    spies.LOG.clear()
    function()
    return spies.LOG.copy()


RESETS = (
    "scene reset", "event at_reset", "observation reset", "action reset", "reward reset", "curriculum reset",
    "command draw", "event interval reset", "event at_reset reset", "event startup reset", "termination reset",
    "recorder reset",
)  # fmt: skip


def _resets(ids):
    return [f"{call} {ids}" for call in RESETS]


def _reset_calls(ids, lengths):
    before = [f"recorder pre_reset {ids}", f"curriculum {ids} at length {lengths}"]
    return [*before, *_resets(ids), "refresh", f"recorder post_reset {ids}", "observation"]


def test_construction(env):
    said = [line for line in spies.LOG if line != "refresh"]
    assert said == [
        "event prestartup None, compiled: False", "play", "event interval made", "event at_reset made",
        "event startup made", "command made", "recorder made", "action made", "observation made", "observation",
        "observation reset [0, 1, 2]", "termination made", "reward made", "curriculum made", "event startup None",
    ]  # fmt: skip


# Recorders read observations without noise and history, before ``recorder post_step``.
END_OF_STEP = ["termination", "reward", "observer", "observation", "recorder post_step"]
LAST_CALLS = ["command compute", "event interval [0, 1, 2]", "refresh", "observation"]


def test_a_step_without_an_end(env):
    env.reset()
    _log_steps(env)
    physics = ["action apply", "write", "physics", "recorder post_physics", "update"]
    start = ["action process", "recorder pre_step", *physics, *physics]
    assert _calls(lambda: env.step(torch.zeros(3, 1))) == [*start, *END_OF_STEP, *LAST_CALLS]


def test_a_step_in_which_an_episode_ends(env):
    env.reset()
    _log_steps(env)
    env.step(torch.zeros(3, 1))
    spies.VALUES["done"] = torch.tensor([0.0, 1.0, 0.0])
    said = _calls(lambda: env.step(torch.zeros(3, 1)))
    reset = ["recorder pre_reset [1]", "curriculum [1] at length [2]", *_resets([1]), "recorder post_reset [1]"]
    assert said[said.index("termination") :] == [*END_OF_STEP, *reset, *LAST_CALLS]
    assert env.episode_length_buf.tolist() == [2, 0, 2]


def test_a_final_observation_is_read_before_anything_is_reset(env):
    env.reset()
    env.keep_final_obs = True
    spies.VALUES["done"] = torch.tensor([0.0, 1.0, 0.0])
    said = _calls(lambda: env.step(torch.zeros(3, 1)))
    assert said.index("reward") < said.index("observation") < said.index("curriculum [1] at length [1]")


def test_without_automatic_resets_nothing_is_reset(env):
    env.reset()
    env.autoreset = "disabled"
    spies.VALUES["done"] = torch.tensor([0.0, 1.0, 0.0])
    said = _calls(lambda: env.step(torch.zeros(3, 1)))
    assert not [line for line in said if "reset" in line]
    assert env.episode_length_buf.tolist() == [1, 1, 1]


def test_a_reset_of_all_or_of_some(env):
    assert _calls(env.reset) == _reset_calls([0, 1, 2], [0, 0, 0])
    env.step(torch.zeros(3, 1))
    assert _calls(lambda: env.reset(env_ids=torch.tensor([0, 2]))) == _reset_calls([0, 2], [1, 1])
