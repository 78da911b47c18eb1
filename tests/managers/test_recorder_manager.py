"""Recorders: what they record and when, how episodes are split, and that recording changes nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import RecorderTerm

HERE = "managers.test_recorder_manager."
STOCK = "wheelleg_exp.mdp.recorders."
OBSERVATIONS = {
    "policy": {
        "enable_corruption": True,
        "history_length": 2,
        "terms": {
            "q": {
                "_target_": "wheelleg_exp.mdp.observations.joint_pos",
                "noise": {"_target_": "wheelleg_exp.mdp.noise.GaussianNoise", "std": 0.5},
            },
            "count": {"_target_": spies.HERE + "CountingObservation"},
        },
    }
}


class Clock(RecorderTerm):
    reads_observations = False

    def _now(self, rows: int) -> torch.Tensor:
        return torch.full((rows, 1), float(self._env.common_step_counter))

    def record_pre_step(self) -> Any:
        return "clock", {"before": self._now(4), "env": torch.arange(4.0).unsqueeze(1)}

    def record_post_physics_decimation_step(self) -> Any:
        return "physics", self._now(4)

    def record_post_step(self) -> Any:
        return "after", self._now(4)

    def record_pre_reset(self, env_ids: torch.Tensor) -> Any:
        return "end", env_ids.unsqueeze(1)

    def record_post_reset(self, env_ids: torch.Tensor) -> Any:
        return "start", self._now(len(env_ids)) + 0.1 * env_ids.unsqueeze(1)


class Observed(RecorderTerm):
    def record_post_step(self) -> Any:
        return "observed", self._env.observation_manager.obs_buf["policy"]


class Returns(RecorderTerm):
    reads_observations = False

    def record_post_step(self) -> Any:
        return spies.VALUES["noted"]


def recorders(*names: str) -> dict[str, Any]:
    return {name: {"_target_": (HERE if name in globals() else STOCK) + name} for name in names}


@pytest.fixture
def make(start_env):
    def made(*names: str, **sections: Any) -> Any:
        spies.VALUES.update(done=torch.zeros(4), won=torch.zeros(4))
        ends = {"success": {"_target_": spies.HERE + "flag", "key": "won"}}
        ends["stop"] = {"_target_": spies.HERE + "SpyTermination"}
        return start_env(recorders=recorders(*names), terminations=ends, observations=OBSERVATIONS, **sections)

    return made


def step(env: Any, ends: Any = (), wins: Any = ()) -> None:
    for key, ids in (("done", ends), ("won", wins)):
        spies.VALUES[key] = torch.tensor([float(i in ids) for i in range(4)])
    env.step(torch.rand(4, 4))


def episodes(arrays: dict[str, np.ndarray], key: str) -> list[np.ndarray]:
    """Split the rows of a quantity into episodes, as the documentation describes."""
    return np.split(arrays[key], np.cumsum(arrays[f"rows/{key}"])[:-1])


def test_each_episode_has_its_own_rows_and_no_others(make):
    """Environment 1 ends in steps 2 and 5, and environment 3 in step 5."""
    env = make("Clock")
    for number in range(1, 6):
        step(env, {2: [1], 5: [1, 3]}.get(number, []))
    (found,) = env.recorder_manager.take().values()
    assert (found["episode/env"].tolist(), found["episode/length"].tolist()) == ([1, 1, 3], [2, 3, 5])
    assert found["episode/last_step"].tolist() == [2, 5, 5]
    assert [rows[:, 0].tolist() for rows in episodes(found, "clock/before")] == [[0, 1], [2, 3, 4], [0, 1, 2, 3, 4]]
    assert [rows[:, 0].tolist() for rows in episodes(found, "after")] == [[1, 2], [3, 4, 5], [1, 2, 3, 4, 5]]
    assert [set(rows[:, 0].tolist()) for rows in episodes(found, "clock/env")] == [{1.0}, {1.0}, {3.0}]
    assert found["rows/physics"].tolist() == [4, 6, 10]  # a control step has two physics steps
    assert found["start"][:, 0].tolist() == pytest.approx([0.1, 2.1, 0.3])
    assert (found["end"][:, 0].tolist(), env.recorder_manager.take()) == ([1, 1, 3], {})


def test_long_episodes_are_whole(make):
    """Rows that are older than all present episodes are dropped."""
    env = make("Clock", episode_length_s=100.0)
    for number in range(1, 301):
        step(env, [0, 1, 2] if number % 7 == 0 else [3] if number % 150 == 0 else [])
    (found,) = env.recorder_manager.take().values()
    cut = zip(found["episode/env"].tolist(), episodes(found, "clock/before"), strict=True)
    rows = [(env_id, part[:, 0].tolist()) for env_id, part in cut]
    assert [part for env_id, part in rows if env_id == 3] == [list(range(150)), list(range(150, 300))]
    assert [part for env_id, part in rows if env_id == 1] == [list(range(n, n + 7)) for n in range(0, 294, 7)]


def test_the_stock_recorders_record_the_environments_values(make):
    names = ("InitialStateRecorder", "PostStepStatesRecorder", "PreStepActionsRecorder")
    env = make(*names, "PostStepProcessedActionsRecorder", "PreStepFlatPolicyObservationsRecorder")
    start = env.scene.robot.data.joint_pos.clone()
    led_to = env.observation_manager.obs_buf["policy"].clone()
    step(env, [2])
    (found,) = env.recorder_manager.take().values()
    manager = env.action_manager
    assert found["initial_state/articulation/robot/joint_position"].tolist() == start[2:3].tolist()
    assert found["actions"].shape == (1, 4)
    assert found["obs"].tolist() == led_to[2:3].tolist()  # the policy's observation includes noise
    wide = sum(manager.get_term(name).processed_actions.shape[1] for name in manager.active_terms)
    assert found["processed_actions"].shape == (1, wide)
    assert found["states/articulation/robot/root_pose"].shape == (1, 7)
    assert not np.array_equal(found["states/articulation/robot/joint_position"][0], start[2].numpy())


def test_observations_at_the_end_of_a_step_are_of_that_state_without_noise(make):
    env = make("Observed")
    before = env.observation_manager.obs_buf["policy"].clone()
    env.keep_final_obs = True
    step(env, [0])
    (found,) = env.recorder_manager.take().values()
    final = env.extras["final_obs"]["policy"][0]  # the final observation has no noise
    assert found["observed"][0].tolist() == final.tolist() != before[0].tolist()
    assert not torch.equal(env.observation_manager.obs_buf["policy"][0], final)


def test_recorders_change_no_number_of_an_environment(make):
    ends = {}
    for names in ((), ("Clock", "Observed", "PostStepStatesRecorder")):
        torch.manual_seed(3)
        env = make(*names)
        for number in range(25):
            step(env, [number % 4] if number % 5 == 0 else [])
        ends[bool(names)] = env.state_dict()
    assert str(ends[True]) == str(ends[False])
    assert torch.equal(ends[True]["scene"]["sim"]["state"], ends[False]["scene"]["sim"]["state"])


@pytest.mark.parametrize(
    ("mode", "groups"),
    [
        ("all", {"episodes": [0, 1]}),
        ("succeeded_failed", {"succeeded": [1], "failed": [0]}),
        ("succeeded_only", {"succeeded": [1]}),
        ("none", {}),
    ],
)
def test_the_export_mode_selects_the_saved_episodes(make, mode, groups):
    env = make("Clock", dataset={"export_mode": mode})
    step(env, [0], wins=[1])
    found = env.recorder_manager.take()
    assert {group: arrays["episode/env"].tolist() for group, arrays in found.items()} == groups
    if mode == "all":
        assert found["episodes"]["episode/success"].tolist() == [False, True]


@pytest.mark.parametrize("wanted", [False, True])
def test_unfinished_episodes_are_saved_at_the_end_if_configured(make, wanted):
    env = make("Clock", dataset={"export_in_close": wanted})
    step(env, [2])
    step(env)
    env.recorder_manager.close()
    env.recorder_manager.close()
    assert env.recorder_manager.take()["episodes"]["episode/length"].tolist() == ([1, 2, 2, 1, 2] if wanted else [1])


def test_episodes_that_started_in_another_process_or_have_no_step_are_left_out(make):
    env = make("Clock")
    env.reset()
    assert env.recorder_manager.take() == {}
    step(env)
    env.load_state_dict(env.state_dict())
    step(env, [0])
    assert env.recorder_manager.take() == {}
    step(env, [0])
    assert env.recorder_manager.take()["episodes"]["episode/length"].tolist() == [1]
    env = make("Clock")
    step(env)
    env.reset(env_ids=torch.tensor([1]))
    assert env.recorder_manager.take()["episodes"]["episode/env"].tolist() == [1]


@pytest.mark.parametrize(
    ("noted", "said"),
    [
        (("k", torch.zeros(3, 1)), "a tensor of shape (3, 1)"),
        (("k", 1.0), "float 1.0"),
        ((None, torch.zeros(4, 1)), "returns None and a tensor"),
        (None, "returns None ("),
        (torch.zeros(4, 1), "returns a tensor of shape (4, 1) ("),
        (("k", torch.zeros(4).numpy()), "a numpy array of shape (4,)"),
        (("k", {"a": [1.0]}), "'k/a'"),
        (("episode/env", torch.zeros(4)), "reserved for data about episodes"),
        (("after", torch.zeros(4)), "is already recorded by"),
    ],
)
def test_values_that_cannot_be_recorded_name_their_term(make, noted, said):
    env = make("Clock", "Returns")
    spies.VALUES["noted"] = noted
    with pytest.raises(ConfigError) as caught:
        step(env)
    assert caught.value.key == "env.recorders.Returns"
    assert said in str(caught.value)


def test_a_shape_that_changes_is_rejected(make):
    env = make("Returns")
    spies.VALUES["noted"] = ("k", torch.zeros(4, 1))
    step(env)
    spies.VALUES["noted"] = ("k", torch.zeros(4, 2))
    with pytest.raises(ConfigError, match=r"env\.recorders\.Returns.*was \(4, 1\)"):
        step(env)
