import json
from pathlib import Path

import pytest
import torch
from jobs.small import copied, trained_once, wheelleg
from refused import refusal

pytestmark = pytest.mark.train

QUICK = ["env.num_envs=2", "recording.enabled=false"]


@pytest.fixture
def run(own_folders, tmp_path, tmp_path_factory):
    return copied(trained_once(tmp_path_factory), tmp_path)


def test_figures_are_a_table_and_the_recording_can_be_opened(run):
    said = wheelleg("play", "latest", "env.num_envs=2")
    assert said.status == 0, said.err
    assert "survived to the time-out" in said.out
    assert "base height, RMSE to target" in said.out
    assert "model_2.pt" in said.out.splitlines()[0]
    (opened,) = [line.split("rerun ")[1] for line in said.out.splitlines() if "rerun " in line]
    assert Path(opened).is_file()
    assert Path(opened).resolve().is_relative_to(run.play)


def test_json_is_one_document_even_without_figures(run, strict_json, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    # The robot does not settle within an episode of 0.3 s, so the figures of height and pitch are NaN.
    said = wheelleg("play", "latest", "--root", tmp_path / "runs", *QUICK, "play.settle_s=5.0", "--json")
    assert said.status == 0, said.err
    document = strict_json(said.out)
    assert (document["run"], document["figures"]["episodes"]) == (str(run.path), 2)


@pytest.mark.parametrize("words", [["--checkpoint", "0"], ["--checkpoint", "model_0.pt"], ["--checkpoint", "PATH"]])
def test_a_checkpoint_is_chosen_by_iteration_name_or_path(run, words):
    words = [str(run.checkpoint(0)) if word == "PATH" else word for word in words]
    said = wheelleg("play", "latest", *words, *QUICK, "--json")
    assert said.status == 0, said.err
    content = json.loads((Path(json.loads(said.out)["folder"]) / "figures.json").read_text())
    assert content["checkpoint"].endswith("model_0.pt")


QUICKLY = {
    "play": QUICK,
    "evaluate": ["protocol.stand.episodes=1", "protocol.stand.horizon_s=1.5", "protocol.stand.survival_s=[1.5]"],
    "export": [],
}


@pytest.mark.parametrize("command", QUICKLY)
def test_a_changed_checkpoint_is_used_with_a_warning(run, command):
    before = wheelleg(command, "latest", *QUICKLY[command])
    assert (before.status, "warning" in before.err) == (0, False), before.err
    state = torch.load(run.checkpoint(2), weights_only=True)
    state["actor_state_dict"]["mlp.0.bias"] += 0.1
    torch.save(state, run.checkpoint(2))
    after = wheelleg(command, "latest", *QUICKLY[command])
    assert after.status == 0, after.err
    (line,) = [line for line in after.err.splitlines() if line.startswith("warning: ")]
    assert "model_2.pt differs from its run's record" in line
    other = wheelleg(command, "latest", "--checkpoint", "1", *QUICKLY[command])
    assert (other.status, "warning" in other.err) == (0, False), other.err


CHECKPOINT = ("latest", "--checkpoint")
# Words after ``wheelleg play``, in which RUN is the folder of the run and TMP its parent, and parts of the message.
REFUSED = [
    *(((*CHECKPOINT, f"RUN/{file}"), (file, "model_<iteration>.pt"))
      for file in ("manifest.json", "exported/policy.pt", "exported/policy.onnx", "recording.rrd")),
    ((), ("RUN",)),
    (("latst",), ("latst", "did you mean 'latest'?")),
    (("RUN/params",), ("not a run directory", "RUN")),
    (("latest", "--root", "TMP/nowhere"), ("no run",)),
    ((*CHECKPOINT, "7"), ("iteration 7", "0, 1, 2", "model_2.pt")),
    (("latest", "robot=physical"), ("robot", "config groups can only be selected for a new run")),
    (("latest", "seed"), ("seed", "key=value")),
]  # fmt: skip


@pytest.mark.parametrize(("words", "expected"), REFUSED, ids=lambda words: " ".join(words))
def test_a_wrong_run_checkpoint_or_override_is_refused(run, words, expected, tmp_path):
    words = [word.replace("RUN", str(run.path)).replace("TMP", str(tmp_path)) for word in words]
    message = refusal("play", *words)
    expected = [part.replace("RUN", str(run.path)) if words else part for part in expected]
    assert [part for part in expected if part not in message] == []
    assert not run.play.exists()
