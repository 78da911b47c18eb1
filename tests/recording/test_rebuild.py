from collections.abc import Mapping

import numpy as np
import pytest
import torch
import yaml

from wheelleg_exp.jobs.rollout_files import config_document
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing.recorder import Recorder

STEPS = 150


def plain(value):
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


@pytest.fixture(scope="module")
def rebuilt(make_env, tmp_path_factory) -> tuple[Recording, dict[int, dict[str, float]]]:
    env, logs = make_env("env.episode_length_s=0.36", num_envs=1), {}
    path = tmp_path_factory.mktemp("rebuilt") / "recording.rrd"
    generator = torch.Generator().manual_seed(5)
    env.reset(seed=1)

    options = {"recording_id": "r", "name": "n", "env_ids": [0]}
    with Recorder(path, env, purpose="play", **options) as recorder, torch.inference_mode():
        env.observers.append(recorder.capture)
        for name, text in config_document({"env": plain(env.cfg)}).items():
            recorder.document(name, text)
        recorder.start()
        for _ in range(STEPS):
            action = 1.5 * torch.randn(1, env.action_manager.total_action_dim, generator=generator)
            env.step(action)
            if env.extras["log_is_fresh"]:
                logs[env.common_step_counter] = {k: float(v) for k, v in env.extras["log"].items()}
    return Recording(path), logs


def values(recording: Recording, entity: str) -> np.ndarray:
    return recording.values(entity)[:, 0]


def config(recording: Recording) -> dict:
    text = recording.document("config")
    assert text is not None
    return yaml.safe_load(text.removeprefix("```yaml\n").removesuffix("\n```"))["env"]


def episodes(recording: Recording) -> dict[int, np.ndarray]:
    number = values(recording, "episode/number")
    ends = values(recording, "episode/terminated") + values(recording, "episode/truncated") > 0
    steps = np.asarray(recording.table("episode/step").column("step"))
    return {int(steps[row]): np.flatnonzero(number == number[row]) for row in np.flatnonzero(ends)}


def test_reward_terms_sum_to_what_the_environment_logs_and_follow_from_the_motion(rebuilt):
    recording, logs = rebuilt
    about = recording.properties["wheelleg"]
    found = episodes(recording)
    assert set(found) == set(logs)
    for step, rows in found.items():
        for term in recording.static("rewards")["terms"]:
            total = np.float32(0)
            for value in values(recording, f"rewards/{term}")[rows].astype(np.float32):
                total += value * np.float32(about["step_dt"])
            logged = logs[step][f"Episode_Reward/{term}"]
            assert total / about["episode_length_s"] == pytest.approx(logged, rel=1e-5, abs=1e-9), term
    rewards = config(recording)["rewards"]
    height, weight = rewards["base_height"]["target_height"], rewards["base_height"]["weight"]
    expected = weight * (values(recording, "base/height") - height) ** 2
    np.testing.assert_allclose(values(recording, "rewards/base_height"), expected, rtol=1e-4, atol=1e-6)
    pitch = rewards["pitch_orientation"]["weight"] * recording.values("base/gravity")[:, 0] ** 2
    np.testing.assert_allclose(values(recording, "rewards/pitch_orientation"), pitch, rtol=1e-5, atol=1e-9)
    alive = rewards["alive"]["weight"] * (1 - values(recording, "episode/terminated"))
    np.testing.assert_allclose(values(recording, "rewards/alive"), alive, rtol=1e-6)
    total = sum(values(recording, f"rewards/{term}") for term in recording.static("rewards")["terms"])
    np.testing.assert_allclose(values(recording, "rewards/total"), total, rtol=1e-4, atol=1e-4)
    assert recording.static("rewards")["weights"] == [float(node["weight"]) for node in rewards.values() if node]


def test_ends_of_episodes_follow_from_forces_and_time(rebuilt):
    recording, logs = rebuilt
    terms, about = config(recording)["terminations"], recording.properties["wheelleg"]
    bodies = recording.names("contacts/contact_forces/peak")
    peak = recording.values("contacts/contact_forces/peak")
    steps = np.asarray(recording.table("episode/step").column("step"))
    contact = peak[:, bodies.index(recording.properties["robot"]["root"])] > terms["base_contact"]["threshold"]
    over = values(recording, "episode/step") >= about["max_episode_length"]
    assert set(steps[contact]) == {s for s, log in logs.items() if log["Episode_Termination/base_contact"]}
    assert set(steps[over]) == {s for s, log in logs.items() if log["Episode_Termination/time_out"]}
    for term in recording.static("terminations")["terms"]:
        fired = set(steps[values(recording, f"terminations/{term}") > 0])
        assert fired == {s for s, log in logs.items() if log[f"Episode_Termination/{term}"]}, term


def test_peaks_and_efforts_follow_from_forces_and_limits(rebuilt):
    recording, _ = rebuilt
    norms = recording.values("contacts/contact_forces")
    assert (recording.values("contacts/contact_forces/peak") >= norms * (1 - 1e-6)).all()
    for joint in recording.properties["robot"]["joints"]:
        (limit,) = recording.static(f"joints/{joint}")["effort_limit"]
        computed, applied = (values(recording, f"joints/{joint}/{kind}") for kind in ("effort_computed", "effort"))
        np.testing.assert_allclose(np.clip(computed, -limit, limit), applied, atol=2e-5)


def test_episode_numbers_and_steps_count_without_gaps(rebuilt):
    recording, logs = rebuilt
    assert all(values(recording, f"episode/{end}").any() for end in ("terminated", "truncated"))
    assert len(logs) > 3
    number, step = (values(recording, f"episode/{name}") for name in ("number", "step"))
    ended = (values(recording, "episode/terminated") + values(recording, "episode/truncated") > 0)[:-1]
    np.testing.assert_array_equal(np.diff(number), ended)
    np.testing.assert_array_equal(step[1:], np.where(ended, 1, step[:-1] + 1))
    assert (number[0], step[0]) == (0, 1)


def test_the_terms_of_an_observation_make_up_the_group(rebuilt):
    recording, _ = rebuilt
    for group, width in (("policy", 135), ("critic", 180)):
        about = recording.static(f"observations/{group}")
        assert sum(about["widths"]) == width == recording.values(f"observations/{group}").shape[1]
        parts = [recording.values(f"observations/{group}/{term}") for term in about["terms"]]
        np.testing.assert_array_equal(np.hstack(parts), recording.values(f"observations/{group}"))
    actions, width = recording.values("actions/raw"), recording.values("actions/raw").shape[1]
    seen = recording.values("observations/critic/last_action")[:, -width:]  # The newest action is last in the history.
    inside = values(recording, "episode/step")[1:] > 1
    np.testing.assert_allclose(seen[1:][inside], actions[:-1][inside], atol=1e-6)
