import json

import pytest
from jobs.small import TINY, wheelleg

pytestmark = pytest.mark.train


def test_a_training_runs_and_its_manifest_states_the_promise_of_the_engine(device, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    short = (*TINY, "agent.max_iterations=1", "recording.enabled=false")
    said = wheelleg("train", "task=stand", "env.sim.engine=warp", f"env.sim.device={device}", *short)
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
