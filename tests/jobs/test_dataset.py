"""Datasets of a training and of an agent: their files, how they are read, and that recording changes no number."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from jobs.small import ITERATIONS, NUM_ENVS, SMALL, Trained, only_run, succeed
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.rollout_files import dataset_files_from
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.run.run_directory import RunDirectory

PAGE = Path(__file__).resolve().parents[2] / "docs" / "datasets.md"
TERMS = "initial_state,post_step_states,pre_step_actions,pre_step_flat_policy_observations"
RECORDERS = f"+recorder@env.recorders=[{TERMS}]"


def episodes(path: Path):
    """Read a dataset file with the code of the page docs/datasets.md."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.S)
    space: dict = {}
    exec(code, space)
    return list(space["episodes"](path))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> RunDirectory:
    """Return a repetition of the shared training with recorder terms."""
    root = tmp_path_factory.mktemp("recorded")
    succeed("train", *SMALL, RECORDERS, f"run.root={root}", "run.name=small")
    return RunDirectory.open(only_run(root), root)


@pytest.mark.train
def test_recorders_leave_every_checkpoint_as_it_is_to_the_bit(recorded: RunDirectory, trained: Trained):
    names = [path.name for path in trained.run.checkpoints()]
    assert len(names) == ITERATIONS
    assert {n: sha256(recorded.path / n) for n in names} == {n: sha256(trained.run.path / n) for n in names}


@pytest.mark.train
def test_each_iteration_has_a_file_of_the_episodes_that_ended_in_it(recorded: RunDirectory):
    files = sorted(recorded.dataset.iterdir())
    assert [path.name for path in files] == [f"{n:06d}.npz" for n in range(ITERATIONS)]
    for number, path in enumerate(files):
        found = np.load(path)
        assert ((found["episode/last_step"] - 1) // 24 == number).all()
        assert found["episode/length"].max() <= 18
    assert recorded.manifest().data["files"]["dataset/000000.npz"]["sha256"] == sha256(files[0])


@pytest.mark.train
def test_an_episode_is_one_piece_of_motion(recorded: RunDirectory):
    for episode in episodes(recorded.dataset / "000001.npz"):
        pose = episode["states/articulation/robot/root_pose"]
        velocity = episode["states/articulation/robot/root_velocity"]
        assert len(pose) == len(episode["actions"]) == len(episode["obs"])
        assert episode["initial_state/articulation/robot/root_pose"].shape == (1, 7)
        np.testing.assert_allclose(np.diff(pose[:, :2], axis=0), velocity[1:, :2] / 60, atol=0.02)
        # Columns 95 to 125 hold the last five actions. The newest action, of the step before, comes last.
        np.testing.assert_allclose(episode["obs"][1:, 119:125], episode["actions"][:-1])


@pytest.mark.train
def test_a_resume_continues_the_dataset(recorded: RunDirectory, monkeypatch, tmp_path):
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])
    path = tmp_path / "runs" / "stand" / recorded.id
    shutil.copytree(recorded.path, path)
    (path / "dataset" / "failed").mkdir()
    killed = [path / "dataset" / name for name in ("000001_unfinished.npz", "failed/000009.npz")]
    for left in (*killed, path / "dataset" / f"{ITERATIONS:06d}.npz"):
        left.write_bytes(b"of a process that was killed")
    succeed("resume", path, f"agent.max_iterations={ITERATIONS + 2}")
    assert [left for left in killed if left.exists()] == []
    found = np.load(max(dataset_files_from(path / "dataset", ITERATIONS)))
    assert len(found["episode/env"]) > 0
    assert (found["episode/last_step"] - found["episode/length"] >= 24 * ITERATIONS).all()


@pytest.mark.train
def test_an_agent_s_episodes_are_in_one_file(tmp_path):
    words = ["task=stand", f"env.num_envs={NUM_ENVS}", "env.episode_length_s=0.3", RECORDERS, "recording.enabled=false"]
    succeed("random-agent", *words, "+env.dataset.export_mode=succeeded_failed", f"run.root={tmp_path}")
    (path,) = tmp_path.rglob("*.npz")
    assert path.relative_to(path.parents[2]).as_posix() == "dataset/failed/episodes.npz"
    found = episodes(path)
    assert sorted(episode["env"] for episode in found) == list(range(NUM_ENVS))
    assert all(np.abs(episode["actions"]).max() <= 1.0 for episode in found)
