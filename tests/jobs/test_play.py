"""Playing a run: what the recording says is what the exported policy does, and figures that can be checked."""

import hashlib
import json
import math
import shutil

import numpy as np
import onnxruntime
import pytest
import torch
import yaml

from jobs.small import ITERATIONS, copied, manifest
from wheelleg_exp.errors import ConfigError, RunDirectoryError, WheellegError
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.play_policy import play
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train


class Silent(Display):
    """A display that counts steps."""

    def steps(self, done, total):
        self.done, self.total = done, total


def played(run, *overrides, iteration=None):
    chosen = None if iteration is None else run.checkpoint(iteration)
    return play(run, chosen, list(overrides), ["wheelleg", "play"], Silent())


def plays(run):
    return sorted(run.play.iterdir()) if run.play.exists() else []


@pytest.fixture(scope="module")
def recording(trained, tmp_path_factory):
    """Return the recording of a play of the last checkpoint."""
    return Recording(played(copied(trained, tmp_path_factory.mktemp("played"))).recording)


def test_the_exported_policy_turns_recorded_observations_into_recorded_actions(run, recording):
    observations = recording.values("observations/policy").astype(np.float32)
    actions = recording.values("actions/raw")
    assert observations.shape == (len(actions), 135)
    assert len(actions) > 10
    session = onnxruntime.InferenceSession(run.exported / "policy.onnx")
    (found,) = session.run(None, {session.get_inputs()[0].name: observations})
    np.testing.assert_allclose(found, actions, atol=1e-5)


def test_an_earlier_checkpoint_gives_other_actions_its_own(run, recording):
    earlier = Recording(played(run, iteration=0).recording)
    x = earlier.values("observations/policy").astype(np.float64)
    weights = checkpoint.load(run.checkpoint(0))["actor_state_dict"]
    layers = sorted({name.rsplit(".", 1)[0] for name in weights if name.startswith("mlp")}, key=lambda n: n)
    for k, layer in enumerate(layers):
        x = x @ weights[f"{layer}.weight"].double().numpy().T + weights[f"{layer}.bias"].double().numpy()
        if k + 1 < len(layers):
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    np.testing.assert_allclose(earlier.values("actions/raw"), x, atol=1e-5)
    assert not np.allclose(recording.values("actions/raw")[0], earlier.values("actions/raw")[0])


def test_figures_are_those_of_the_recorded_heights_and_pitches(run):
    done = played(run, "env.num_envs=1", "play.settle_s=0.1")
    recording, figures = Recording(done.recording), done.figures
    heights, pitches = (recording.values(f"base/{name}").ravel() for name in ("height", "pitch"))
    settled = slice(6, None)
    assert (figures.episodes, figures.height_mean_m) == (1, pytest.approx(heights[settled].mean(), rel=1e-4))
    assert figures.height_rmse_m == pytest.approx(math.sqrt(((heights[settled] - 0.07) ** 2).mean()), rel=1e-4)
    pitch_rms = math.sqrt((pitches[settled] ** 2).mean())
    assert figures.pitch_rms_deg == pytest.approx(math.degrees(pitch_rms), rel=1e-3, abs=1e-3)
    total = recording.values("rewards/total").ravel() / 60
    assert (figures.mean_return, figures.survival) == (pytest.approx(total.sum(), rel=1e-4), float(len(heights) == 18))
    assert sum(figures.ended_by.values()) >= 1


def test_a_play_changes_nothing_of_the_training_and_adds_an_entry_to_the_manifest(run):
    files = [*run.path.glob("*"), run.params / "env.yaml"]
    contents = {p: p.read_bytes() for p in files if p.is_file() and p.name != "manifest.json"}
    before = manifest(run.path)
    done = played(run, "env.num_envs=3", "env.episode_length_s=0.1", "seed=7")
    assert (done.figures.episodes, done.figures.survival) == (3, 1.0)  # No robot falls in 0.1 s.
    assert {path: path.read_bytes() for path in contents} == contents
    data = manifest(run.path)
    (entry,) = data["additions"]
    assert (entry["kind"], entry["command"]) == ("play", ["wheelleg", "play"])
    folder = done.folder.relative_to(run.path)
    assert set(entry["files"]) == {f"{folder}/figures.json", f"{folder}/recording.rrd"}
    for name, record in entry["files"].items():
        assert record["sha256"] == hashlib.sha256((run.path / name).read_bytes()).hexdigest()
    assert [key for key in before if data[key] != before[key]] == ["additions", "sha256"]
    assert not run.manifest().compare_files()


def test_figures_and_recording_name_the_played_policy_and_its_result(run):
    done = played(run, "env.num_envs=2", "seed=7", iteration=1)
    content = json.loads((done.folder / "figures.json").read_text())
    weights = run.checkpoint(1)
    assert content["checkpoint"].endswith("model_1.pt")
    assert content["checkpoint_sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert (content["seed"], content["overrides"]) == (7, ["env.num_envs=2", "seed=7"])
    assert content["survival"] == done.figures.survival
    recording = Recording(done.recording)
    about = recording.properties["wheelleg"]
    assert (about["purpose"], about["agent"], about["task"]) == ("play", "policy", "stand")
    assert (about["run_id"], about["seed"], about["num_envs"], about["checkpoint"]) == (run.id, 7, 2, "model_1.pt")
    assert about["checkpoint_sha256"] == hashlib.sha256(run.checkpoint(1).read_bytes()).hexdigest()
    texts = {name: recording.document(name).splitlines() for name in recording.documents()}
    assert json.loads("\n".join(texts["figures"][1:-1])) == content
    assert yaml.safe_load("\n".join(texts["config"][1:-1]))["env"]["num_envs"] == 2
    assert json.loads("\n".join(texts["manifest"][1:-1]))["id"] == run.id
    assert {"git", "command", "checkpoint"} <= set(texts)


def test_unrecorded_plays_write_no_recording_share_no_folder_and_end_with_the_last_first_episode(run):
    display, words = Silent(), ["env.num_envs=2", "recording.enabled=false"]
    made = [play(run, None, words, ["wheelleg", "play"], display) for _ in range(2)]
    assert display.done <= display.total == 18
    assert len({done.folder for done in made}) == 2
    assert made[0].recording is None
    assert [p.name for p in made[0].folder.iterdir()] == ["figures.json"]


def test_the_same_seed_plays_the_same(run):
    def actions(*overrides):
        return Recording(played(run, "env.num_envs=2", *overrides).recording).values("actions/raw")

    first = actions("seed=3")
    torch.manual_seed(99)
    assert np.array_equal(first, actions("seed=3"))
    other = actions("seed=4")
    assert first.shape != other.shape or not np.array_equal(first, other)


@pytest.mark.parametrize("conditions", ["undisturbed", "training"])
def test_a_play_omits_the_training_disturbances_and_reports_it(run, conditions):
    shown = Silent()
    shown.notes = []
    shown.note = shown.notes.append
    words = ["env.num_envs=1", "env.episode_length_s=0.1", f"play.conditions={conditions}"]
    done = play(run, None, words, ["wheelleg", "play"], shown)
    content = json.loads((done.folder / "figures.json").read_text())
    text = Recording(done.recording).document("config")
    events = yaml.safe_load("\n".join(text.splitlines()[1:-1]))["env"]["events"]
    undisturbed = conditions == "undisturbed"
    assert (content["conditions"], "push_robot" in events) == (conditions, not undisturbed)
    assert "reset_base" in events
    assert len([line for line in shown.notes if "play.conditions=training" in line]) == undisturbed


def test_an_override_of_a_disturbance_needs_the_conditions_of_the_training(run):
    words = ["env.num_envs=1", "env.episode_length_s=0.1", "recording.enabled=false", "env.events.push_robot.frame=yaw"]
    with pytest.raises(ConfigError, match=r"ignores the key.*expected play\.conditions=training"):
        played(run, *words)
    assert played(run, *words, "play.conditions=training").figures.episodes == 1


@pytest.mark.parametrize(
    ("override", "key"),
    [
        ("env.num_evns=4", "env.num_evns"),
        ("env.num_envs=0", "env.num_envs"),
        ("env.rewards.alive._target_=os.system", "env.rewards.alive._target_"),
        ("env.robot.asset=other.usda", "env.robot.asset"),
        ("env.robot.base=fixed", "env.robot.base"),
        ("seed=-1", "seed"),
        ("play.settle_s=-1", "play.settle_s"),
        ("recording.env_ids=[99]", "recording.env_ids"),
        ("agent.critic.hidden_dims=[4]", "agent.critic.hidden_dims"),
    ],
)
def test_a_wrong_override_is_reported_and_writes_nothing(run, override, key):
    before = (run.path / "manifest.json").read_bytes()
    with pytest.raises(ConfigError) as caught:
        played(run, override)
    assert key in str(caught.value)
    assert override != "env.num_evns=4" or caught.value.nearest == "env.num_envs"
    assert (plays(run), (run.path / "manifest.json").read_bytes()) == ([], before)


@pytest.mark.parametrize(
    "override", ["env.observations.policy.history_length=2", "~env.actions.wheel_vel", "agent.actor.hidden_dims=[4]"]
)
def test_a_policy_that_does_not_fit_is_rejected(run, override):
    with pytest.raises(RunDirectoryError, match="fit"):
        played(run, override)
    assert plays(run) == []


@pytest.mark.parametrize(
    "name", ["params/env.yaml", "params/agent.yaml", "asset/robot.xml", f"model_{ITERATIONS - 1}.pt"]
)
@pytest.mark.parametrize("damage", ["missing", "garbage"])
def test_a_damaged_run_is_reported(run, name, damage):
    file = run.path / name
    if damage == "missing" and name.startswith("model"):
        for path in run.checkpoints():
            path.unlink()
    elif damage == "missing":
        file.unlink()
    else:
        file.write_bytes(b"\x00[: {broken\n" * 9)
    with pytest.raises(WheellegError) as caught:
        played(run)
    message = str(caught.value)
    assert "model_" in message if name.startswith("model") else file.name in message
    assert (len(message.splitlines()), plays(run)) == (1, [])


def test_a_robot_with_meshes_is_played_from_the_run_alone(run, monkeypatch, tmp_path):
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path / "empty"))
    moved = tmp_path / "elsewhere"
    shutil.move(run.path, moved)
    assert played(RunDirectory.open(moved, tmp_path), "env.num_envs=1").recording.is_relative_to(moved)
    assert not (tmp_path / "empty").exists()
