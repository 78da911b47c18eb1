"""A student learns from a run's policy, and the student's run does not need the teacher's run."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from jobs.small import NUM_ENVS, Trained, cache_of, refused, succeed
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train

WORDS = [
    *("task=stand", "agent=distillation", f"env.num_envs={NUM_ENVS}", "env.episode_length_s=0.3"),
    *("env.sim.nthread=1", "agent.torch_threads=1", "agent.save_interval=1", "recording.enabled=false"),
    *("agent.student.hidden_dims=[32,16]", "agent.teacher.hidden_dims=[16,8]", "agent.algorithm.learning_rate=0.01"),
]


def train(root: Path, teacher: Path, *words: str) -> RunDirectory:
    succeed("train", *WORDS, f"agent.teacher_checkpoint={teacher}", f"run.root={root}", *words)
    return RunDirectory.open(next((root / "stand").iterdir()), root)


@pytest.fixture(scope="module")
def student(trained: Trained, tmp_path_factory) -> RunDirectory:
    """Return six iterations of a student whose teacher's run is removed afterwards."""
    root = tmp_path_factory.mktemp("student")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        teacher = root / "teachers" / trained.run.id
        shutil.copytree(trained.run.path, teacher)
        run = train(root / "runs", teacher, "agent.max_iterations=6")
        shutil.rmtree(teacher)
    return run


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_student_comes_to_answer_as_its_teacher_does(student: RunDirectory):
    lines = [json.loads(line) for line in student.iterations.read_text().splitlines()]
    losses = [line["scalars"]["Loss/behavior"] for line in lines]
    assert losses[-1] < 0.2 * losses[0]


def test_the_teacher_is_the_run_s_actor_and_stays_so(student: RunDirectory, trained: Trained):
    actor = checkpoint.load(trained.run.latest_checkpoint())["actor_state_dict"]
    for path in student.checkpoints():
        teacher = checkpoint.load(path)["teacher_state_dict"]
        assert teacher.keys() == actor.keys()
        assert all(torch.equal(teacher[name], actor[name]) for name in actor)


def test_the_run_keeps_its_teacher_with_its_digest(student: RunDirectory, trained: Trained):
    kept = student.asset / "networks" / "teacher.pt"
    assert digest(kept) == digest(trained.run.latest_checkpoint())
    assert json.loads((student.asset / "asset.json").read_text())["sources"]["networks/teacher.pt"] == digest(kept)


def test_the_exported_policy_is_the_student(student: RunDirectory):
    state = checkpoint.load(student.latest_checkpoint())["student_state_dict"]
    seen = torch.randn(3, 135)
    hidden = seen
    weights = [value for name, value in state.items() if name.startswith("mlp")]
    for number, (matrix, bias) in enumerate(zip(weights[::2], weights[1::2], strict=True)):
        hidden = hidden @ matrix.T + bias
        hidden = torch.nn.functional.elu(hidden) if number < 2 else hidden
    session = onnxruntime.InferenceSession(student.exported / "policy.onnx")
    (actions,) = session.run(None, {session.get_inputs()[0].name: seen.numpy()})
    np.testing.assert_allclose(actions, hidden.numpy(), atol=1e-5)


def test_a_student_that_was_stopped_goes_on_to_the_bit(student: RunDirectory, trained: Trained, tmp_path, monkeypatch):
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])
    teacher = tmp_path / "teacher.pt"
    shutil.copyfile(trained.run.latest_checkpoint(), teacher)
    run = train(tmp_path / "runs", teacher, "agent.max_iterations=2")
    teacher.unlink()
    said = succeed("resume", run.path, "agent.max_iterations=6")
    assert "not exact" not in said.out + said.err
    assert digest(run.checkpoint(5)) == digest(student.checkpoint(5))


def test_a_student_plays(student: RunDirectory, tmp_path):
    path = tmp_path / "runs" / "stand" / student.id
    shutil.copytree(student.path, path)
    succeed("play", path, "recording.enabled=false")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["agent.teacher_checkpoint=nobody"], "agent.teacher_checkpoint"),
        (["agent.teacher.hidden_dims=[8,8]"], "agent.teacher and agent.obs_groups.teacher"),
    ],
)
def test_a_teacher_that_cannot_teach_is_told(trained: Trained, tmp_path, words, said):
    teacher = f"agent.teacher_checkpoint={trained.run.path}"
    found = refused("train", *WORDS, teacher, f"run.root={tmp_path}", *words)
    assert said in found
    assert len(found.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
