"""The whole way: a training on the engine through the command line, and what its manifest promises."""

from __future__ import annotations

import json

import pytest
from jobs.small import wheelleg

pytestmark = pytest.mark.train

TINY = (
    "env.num_envs=8",
    "env.episode_length_s=0.3",
    "agent.torch_threads=1",
    "agent.num_steps_per_env=8",
    "agent.actor.hidden_dims=[16,8]",
    "agent.critic.hidden_dims=[16,8]",
    "agent.algorithm.num_learning_epochs=1",
    "agent.max_iterations=1",
    "recording.enabled=false",
)


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def test_a_training_runs_and_its_manifest_says_what_the_engine_promises(device, tmp_path):
    said = wheelleg("train", "task=stand", "env.sim.engine=warp", f"env.sim.device={device}", *TINY)
    assert said.status == 0, said.err
    (run,) = (tmp_path / "runs" / "stand").iterdir()
    engine = json.loads((run / "manifest.json").read_text())["engine"]
    assert engine["name"] == "warp"
    assert engine["device"] == device
    assert engine["exact"] is (device == "cpu")
    assert (engine["because"] is None) is (device == "cpu")
    said = wheelleg("resume", str(run), "agent.max_iterations=2")
    assert said.status == 0, said.err
    (entry,) = json.loads((run / "manifest.json").read_text())["resumes"]
    assert entry["exact"] is (device == "cpu") or "does not repeat to the bit" in str(entry["why"])
