"""A student learns from a run's policy, and the student's run does not need the teacher's run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

from jobs.small import NUM_ENVS, Trained, copied, lines, only_run, refused, succeed
from wheelleg_exp.files import sha256
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
    return RunDirectory.open(only_run(root), root)


@pytest.fixture(scope="module")
def student(trained: Trained, tmp_path_factory) -> RunDirectory:
    """Return six iterations of a student whose teacher's run is removed afterwards."""
    root = tmp_path_factory.mktemp("student")
    teacher = copied(trained, root / "teachers")
    run = train(root / "runs", teacher.path, "agent.max_iterations=6")
    shutil.rmtree(teacher.path)
    return run


def test_the_student_approaches_its_teacher_which_is_the_trained_actor_and_stays_unchanged(student, trained: Trained):
    losses = [line["scalars"]["Loss/behavior"] for line in lines(student.path)]
    assert losses[-1] < 0.2 * losses[0]
    actor = checkpoint.load(trained.run.latest_checkpoint())["actor_state_dict"]
    for path in student.checkpoints():
        teacher = checkpoint.load(path)["teacher_state_dict"]
        assert teacher.keys() == actor.keys()
        assert all(torch.equal(teacher[name], actor[name]) for name in actor)
    recorded = json.loads((student.asset / "asset.json").read_text())["sources"]["networks/teacher.pt"]
    assert sha256(student.asset / "networks" / "teacher.pt") == sha256(trained.run.latest_checkpoint()) == recorded


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


def test_a_stopped_student_resumes_to_the_bit(student: RunDirectory, trained: Trained, tmp_path, monkeypatch):
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])
    teacher = tmp_path / "teacher.pt"
    shutil.copyfile(trained.run.latest_checkpoint(), teacher)
    run = train(tmp_path / "runs", teacher, "agent.max_iterations=2")
    teacher.unlink()
    said = succeed("resume", run.path, "agent.max_iterations=6")
    assert "not exact" not in said.out + said.err
    assert sha256(run.checkpoint(5)) == sha256(student.checkpoint(5))


def test_a_student_plays(student: RunDirectory, tmp_path):
    succeed("play", shutil.copytree(student.path, tmp_path / "runs" / "stand" / student.id), "recording.enabled=false")


MISTAKES = [("agent.teacher_checkpoint=nobody", "agent.teacher_checkpoint")]
MISTAKES += [("agent.teacher.hidden_dims=[8,8]", "agent.teacher and agent.obs_groups.teacher")]


@pytest.mark.parametrize(("word", "message"), MISTAKES)
def test_an_unsuitable_teacher_is_refused_in_one_line(trained: Trained, tmp_path, word, message):
    teacher = f"agent.teacher_checkpoint={trained.run.path}"
    found = refused("train", *WORDS, teacher, f"run.root={tmp_path}", word)
    assert message in found
    assert (len(found.strip().splitlines()), list(tmp_path.iterdir())) == (1, [])
