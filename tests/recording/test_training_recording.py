import copy
import functools
import json
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from patience import thinned

from wheelleg_exp.config.schema import RecordingOptions
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.jobs.train.training_recording import TrainingRecording
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.rrd_file import RrdFile
from wheelleg_exp.recording.writing.recorder import Recorder
from wheelleg_exp.run.manifest import FORMAT
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.slow

ROLLOUT = 20  # control steps of a training iteration
LONGEST = 45 - 1 + 24  # The longest sample: its last episode has 24 steps.
OPTIONS = {"enabled": True, "env_ids": [1], "interval": 3, "steps": 45, "max_mb": 200.0, "live": False}
digests = functools.cache(entity_digests)  # of files that do not change
ACTIONS = 0.5 * torch.randn(10 * ROLLOUT, 2, 6, generator=torch.Generator().manual_seed(2))


@pytest.fixture(scope="module")
def env(make_env):
    return make_env("env.episode_length_s=0.4", num_envs=2)


@pytest.fixture
def directory(tmp_path) -> RunDirectory:
    return a_directory(tmp_path)


def a_directory(root: Path) -> RunDirectory:
    directory = RunDirectory.create(root / "runs", "stand", 0)
    begun = {"format": FORMAT, "status": "running", "task": "stand", "started": "2026-01-01T00:00:00+00:00"}
    empty = {"command": ["wheelleg", "train"], "results": {}, "resumes": [], "additions": [], "files": {}}
    (directory.path / "manifest.json").write_text(json.dumps({**begun, **empty, "ended": None}))
    return directory


def options(**changes) -> RecordingOptions:
    return RecordingOptions(**{**OPTIONS, **changes})


def scalars(iteration: int) -> dict[str, float]:
    found = {"Train/mean reward": 0.1 * iteration, "Loss/value": -1.0 / (1 + iteration)}
    return found if iteration < 2 else {**found, "Episode_Reward/alive": float(iteration)}


@dataclass(frozen=True)
class Lived:
    steps: list[int]
    iterations: list[int]
    total: float
    ended_by: tuple[str, ...]


@functools.cache
def lived(env, env_id: int, until: int) -> list[Lived]:
    env.common_step_counter = 0
    env.reset(seed=4)
    rows: list[tuple] = []

    def watch() -> None:
        manager = env.termination_manager
        fired = tuple(name for name in manager.active_terms if manager.get_term(name)[env_id])
        rows.append((env.common_step_counter, float(env.reward_buf[env_id]), bool(manager.dones[env_id]), fired))

    env.observers.append(watch)
    with torch.inference_mode():
        for action in ACTIONS[: until * ROLLOUT]:
            env.step(action)
    env.observers.remove(watch)
    found, ends = [], [0, *(i + 1 for i, row in enumerate(rows) if row[2]), len(rows)]
    for a, b in pairwise(ends):
        part = rows[a:b]
        steps = [row[0] for row in part]
        total = sum(row[1] for row in part)
        found += [Lived(steps, [(k - 1) // ROLLOUT for k in steps], total, part[-1][3])] if part else []
    return found


def sampled(episodes: list[Lived], until: int) -> list[Lived]:
    found: list[Lived] = []
    for due in range(0, until * ROLLOUT, 3 * ROLLOUT):
        taken = 0
        for episode in episodes:
            if due < episode.steps[0] <= due + 3 * ROLLOUT and taken < 45:
                found.append(episode)
                taken += len(episode.steps)
    return found


def train(env, directory, until, *, start=0, checkpoint_at=None, **changes) -> dict | None:
    kept = None
    if start == 0:
        env.common_step_counter = 0
        env.reset(seed=4)
        env.event_manager.fired.clear()
    made = TrainingRecording(directory, env, options(**changes), {"config": "c"}, start_iteration=start)
    with made as recording, torch.inference_mode():
        for iteration in range(start, until):
            for action in ACTIONS[iteration * ROLLOUT :][:ROLLOUT]:
                env.step(action)
            recording.write(scalars(iteration), iteration)
            if iteration + 1 == checkpoint_at:
                recording.flush()
                kept = {"state": env.state_dict(), "bytes": directory.recording.stat().st_size}
    return kept


def go_on(env, directory, kept, start, until, **changes) -> dict | None:
    env.load_state_dict(copy.deepcopy(kept["state"]))
    env.event_manager.fired.clear()
    return train(env, directory, until, start=start, **changes)


@pytest.fixture(scope="module")
def straight(env, tmp_path_factory) -> Path:
    directory = a_directory(tmp_path_factory.mktemp("straight"))
    train(env, directory, 7)
    return directory.recording


@pytest.fixture(scope="module")
def stopped(env, tmp_path_factory) -> tuple[Path, dict]:
    directory = a_directory(tmp_path_factory.mktemp("stopped"))
    with pytest.MonkeyPatch.context() as patch:  # A killed process does not optimize its recording.
        patch.setattr("wheelleg_exp.recording.writing.recording_file.optimize_recording", lambda path: None)
        kept = train(env, directory, 5, checkpoint_at=4)
    assert kept is not None
    return directory.recording, kept


def rows(path: Path, entity: str = "base/height") -> list[tuple[int, int]]:
    table = Recording(path).table(entity)
    return list(zip(table.column("step").to_pylist(), table.column("iteration").to_pylist(), strict=True))


def test_samples_are_whole_episodes_with_their_iterations_returns_and_ends(env, straight):
    samples = sampled(lived(env, 1, 7), 7)
    assert rows(straight) == [pair for one in samples for pair in zip(one.steps, one.iterations, strict=True)]
    late = [one for one in samples if one.iterations[0] >= 3]
    assert late
    assert late[0].steps[0] > 3 * ROLLOUT + 1, "the environment must be in mid-episode when the second sample is due"
    expected = [one for one in samples if one.ended_by]
    found = [one for one in summarize(Recording(straight), Selection(begin=Length(0, True))).episodes if one.ended_by]
    assert all(one.is_from_start for one in found)
    assert [one.ended_by for one in found] == [one.ended_by for one in expected]
    assert [one.total_reward for one in found] == pytest.approx([one.total for one in expected], rel=1e-5)


def test_environments_are_sampled_each_from_its_own_beginning(env, directory):
    train(env, directory, 7, env_ids=[0, 1])
    recording = Recording(directory.recording)
    for env_id in (0, 1):
        episodes = sampled(lived(env, env_id, 7), 7)
        steps = recording.table(f"env_{env_id}/base/height").column("step").to_pylist()
        assert steps == [step for one in episodes for step in one.steps]
        assert len(recording.events("episodes", env_id)) == sum(bool(one.ended_by) for one in episodes)


def test_every_iteration_has_its_scalars_and_the_recording_describes_itself(straight, env):
    recording = Recording(straight)
    for key, first in (("Train/mean\\ reward", 0), ("Loss/value", 0), ("Episode_Reward/alive", 2)):
        table = recording.table(f"training/{key}")
        assert table.column("iteration").to_pylist() == list(range(first, 7))
        assert table.column("step").to_pylist() == [(i + 1) * ROLLOUT for i in range(first, 7)]
        expected = [scalars(i)[key.replace("\\", "")] for i in range(first, 7)]
        assert recording.values(f"training/{key}")[:, 0].tolist() == expected
    about = recording.properties["wheelleg"]
    assert (about["purpose"], about["task"], about["format_version"]) == ("training", "stand", 2)
    assert (about["step_dt"], about["num_envs"], about["run_id"]) == (env.step_dt, 2, straight.parent.name)
    assert recording.document("config") == "c"
    assert "wheelleg train" in recording.document("command")
    assert '"task": "stand"' in recording.document("manifest")


@pytest.mark.parametrize("checkpoints", thinned([[1], [3], [6], [2, 4]], 3))
def test_a_split_training_has_the_recording_of_a_straight_one(env, straight, directory, checkpoints):
    kept = train(env, directory, min(checkpoints[0] + 1, 6), checkpoint_at=checkpoints[0])
    for start, stop in pairwise(checkpoints):
        kept = go_on(env, directory, kept, start, stop + 1, checkpoint_at=stop)
    go_on(env, directory, kept, checkpoints[-1], 7)
    assert entity_digests(directory.recording) == digests(straight)
    assert Recording(directory.recording).document("config") == "c"
    assert not list(directory.path.glob("*.damaged*"))
    assert not list(directory.path.glob(".*.tmp"))


def test_a_file_that_ends_anywhere_after_the_checkpoint_is_continued(env, stopped, tmp_path):
    path, kept = stopped
    whole = digests(path)
    data, later = path.read_bytes(), [span for span in RrdFile(path).messages() if span.begin >= kept["bytes"]]
    ends = [later[0].begin + 7, later[0].begin + 16, (later[1].begin + later[1].end) // 2]
    for number, end in enumerate([kept["bytes"], *ends, len(data) - 1]):
        directory = a_directory(tmp_path / str(number))
        directory.recording.write_bytes(data[:end])
        go_on(env, directory, kept, 4, 5)
        assert entity_digests(directory.recording) == whole, end


def test_a_file_that_ends_before_the_checkpoint_is_extended_or_moved_aside(env, stopped, tmp_path):
    path, kept = stopped
    data, there = path.read_bytes(), [span for span in RrdFile(path).messages() if span.end <= kept["bytes"]]
    early, half, late = there[2], there[len(there) // 2], there[-1]
    for number, end in enumerate([0, 11, 13, early.end, (half.begin + half.end) // 2, late.end - 1]):
        directory = a_directory(tmp_path / str(number))
        directory.recording.write_bytes(data[:end])
        go_on(env, directory, kept, 4, 5)
        aside = list(directory.path.glob("*.damaged*"))
        assert not aside or aside[0].read_bytes() == data[:end]
        found = rows(directory.recording)
        assert found[-1] == (5 * ROLLOUT, 4), end
        assert [row for row in found if row[1] < 4] == rows_of(data[:end], directory.path / "cut.rrd", bool(aside))


def rows_of(data: bytes, path: Path, is_aside: bool) -> list[tuple[int, int]]:
    if is_aside:
        return []
    path.write_bytes(data)
    recording = Recording(path)
    return [row for row in rows(path) if row[1] < 4] if recording.has_rows("base/height") else []


@pytest.mark.parametrize("content", [b"precious" * 9, b"", b"RRF2" + bytes(90)])
def test_a_file_that_is_no_recording_is_moved_aside_and_reported(env, stopped, directory, content):
    directory.recording.write_bytes(content)
    (directory.path / "recording.rrd.damaged").write_bytes(b"an earlier one")
    go_on(env, directory, stopped[1], 4, 5)
    assert (directory.path / "recording.rrd.damaged-2").read_bytes() == content
    assert (directory.path / "recording.rrd.damaged").read_bytes() == b"an earlier one"
    (text,) = Recording(directory.recording).table("log/recording").column("text").to_pylist()
    assert "recording.rrd.damaged-2" in text[0]
    assert "starts with iteration 4" in text[0]


@pytest.mark.parametrize("offset", thinned([0, 8, 16, 40], 2))  # kind, length, payload, and rows of a message
def test_a_file_damaged_in_the_middle_is_moved_aside(env, stopped, directory, offset):
    path, kept = stopped
    data, found = bytearray(path.read_bytes()), list(RrdFile(path).messages())
    hit = found[len(found) // 3].begin + offset
    data[hit : hit + 200] = bytes(200)
    directory.recording.write_bytes(data)
    go_on(env, directory, kept, 4, 5)
    assert (directory.path / "recording.rrd.damaged").read_bytes() == bytes(data)
    begins = [one.steps[0] for one in lived(env, 1, 5)]
    assert rows(directory.recording)[0] == (min(step for step in begins if step > 4 * ROLLOUT), 4)


def test_a_missing_file_is_reported(env, stopped, directory):
    go_on(env, directory, stopped[1], 4, 5)
    (text,) = Recording(directory.recording).table("log/recording").column("text").to_pylist()
    assert text == ["the earlier part of this recording is missing; this one starts with iteration 4"]


def test_an_interrupted_rewriting_leaves_the_old_file_and_its_rest_is_removed(env, stopped, directory):
    directory.recording.write_bytes(stopped[0].read_bytes())
    left = directory.path / ".recording.rrd.0123456789ab.tmp"
    left.write_bytes(b"half a file")
    go_on(env, directory, stopped[1], 4, 5)
    assert not left.exists()
    assert entity_digests(directory.recording) == digests(stopped[0])


@pytest.fixture(scope="module")
def bound(env, tmp_path_factory) -> float:
    path = tmp_path_factory.mktemp("bound") / "r.rrd"
    with Recorder(path, env, recording_id="r", name="n", env_ids=[1], purpose="training") as recorder:
        return next(mb for mb in np.arange(0.0, 50.0, 0.01).round(2).tolist() if recorder.frames_within(mb) >= LONGEST)


def test_at_the_size_limit_motion_stops_and_scalars_continue(env, directory, bound):
    train(env, directory, 7, max_mb=bound)
    recording = Recording(directory.recording)
    assert {iteration for _, iteration in rows(directory.recording)} == {0, 1, 2}
    assert recording.table("training/Loss/value").column("iteration").to_pylist() == list(range(7))
    table = recording.table("log/recording")
    assert table.column("step").to_pylist() == [3 * ROLLOUT]
    text = f"the bound of {bound:g} MB is reached after 1 sample; from here on there are scalars alone"
    assert table.column("text").to_pylist() == [[text]]
    assert directory.recording.stat().st_size < bound * 1e6
    directory.recording.unlink()
    train(env, directory, 3, max_mb=0.0)
    recording = Recording(directory.recording)
    assert not recording.has_rows("base/height")
    assert len(recording.table("training/Loss/value")) == 3
    assert len(recording.table("log/recording")) == 1


def test_a_bound_counts_the_frames_that_there_are(env, directory):
    episodes = lived(env, 1, 9)
    frames = sum(len(one.steps) for one in sampled(episodes, 6)) + LONGEST
    assert frames < 3 * LONGEST
    with Recorder(directory.path / "r.rrd", env, recording_id="r", name="n", env_ids=[1], purpose="training") as made:
        enough = made.megabytes(frames)
        assert made.frames_within(enough) < 3 * LONGEST
    train(env, directory, 9, max_mb=enough)
    assert [step for step, _ in rows(directory.recording)] == [k for one in sampled(episodes, 9) for k in one.steps]
    assert rows(directory.recording)[-1][1] >= 7


def test_a_bound_too_small_for_a_sample_is_rejected_at_the_start(env, directory, bound):
    made = TrainingRecording(directory, env, options(max_mb=0.1), {})
    (note,) = made.notes
    assert "recording.max_mb=0.1 leaves no room for a sample, which has up to 68 steps" in note
    enough = float(re.search(r"([\d.]+) are enough for one", note)[1])
    assert bound <= enough < bound + 0.11
    said: list[str] = []
    made.warn(said.append)
    assert said == [f"warning: {note}"]
    with made:
        pass
    (event,) = Recording(directory.recording).events("recording")
    assert event.text == note
    directory.recording.unlink()
    with TrainingRecording(directory, env, options(max_mb=bound), {}) as made:
        assert not made.notes
