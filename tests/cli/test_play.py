from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from jobs.small import cache_of, copied, trained_once, wheelleg

pytestmark = pytest.mark.train

QUICK = ["env.num_envs=2", "recording.enabled=false"]


@pytest.fixture
def run(tmp_path, tmp_path_factory, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
    return copied(trained_once(tmp_path_factory), tmp_path)


def told(said, *words):
    """Check that a command failed with status 2 and one line on standard error that contains the words."""
    assert said.status == 2, said.err
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert line.startswith("wheelleg: error: ")
    assert [word for word in words if word not in line] == []


def test_figures_are_a_table_and_the_recording_can_be_opened(run):
    said = wheelleg("play", "latest", "env.num_envs=2")
    assert said.status == 0, said.err
    assert "survived to the time-out" in said.out
    assert "base height, RMSE to target" in said.out
    assert "model_2.pt" in said.out.splitlines()[0]
    (opened,) = [line.split("rerun ")[1] for line in said.out.splitlines() if "rerun " in line]
    assert Path(opened).is_file()
    assert Path(opened).resolve().is_relative_to(run.play)


@pytest.mark.parametrize("way", ["latest", "id", "task and id", "path", "root"])
def test_a_run_is_found_by_latest_id_or_path(run, way, tmp_path, monkeypatch):
    names = {"id": run.id, "task and id": f"stand/{run.id}", "path": run.path}
    words = [names.get(way, "latest"), *QUICK, "--json"]
    if way == "root":
        monkeypatch.chdir(tmp_path.parent)
        words += ["--root", tmp_path / "runs"]
    said = wheelleg("play", *words)
    assert said.status == 0, said.err
    assert json.loads(said.out)["run"] == str(run.path)


def test_json_is_one_document_even_without_figures(run):

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    # The robot does not settle within an episode of 0.3 s, so the figures of height and pitch are NaN.
    said = wheelleg("play", "latest", *QUICK, "play.settle_s=5.0", "--json")
    assert said.status == 0, said.err
    document = json.loads(said.out, parse_constant=refuse)
    assert document["figures"]["episodes"] == 2


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
def test_a_checkpoint_that_somebody_has_changed_is_used_with_a_warning(run, command):
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


@pytest.mark.parametrize("file", ["manifest.json", "exported/policy.pt", "exported/policy.onnx", "recording.rrd"])
def test_a_file_that_is_no_checkpoint_is_told(run, file):
    told(wheelleg("play", "latest", "--checkpoint", run.path / file), file, "model_<iteration>.pt")


def test_a_run_or_checkpoint_that_does_not_exist_is_told(run, tmp_path):
    told(wheelleg("play"), "RUN")
    told(wheelleg("play", "latst"), "latst", "did you mean 'latest'?")
    told(wheelleg("play", "runs/stand"), "not a run directory", "manifest.json")
    told(wheelleg("play", tmp_path), "not a run directory")
    told(wheelleg("play", run.play.parent / "params"), "not a run directory", str(run.path))
    told(wheelleg("play", "latest", "--root", tmp_path / "nowhere"), "no run")
    told(wheelleg("play", "latest", "--checkpoint", "7"), "iteration 7", "0, 1, 2", "model_2.pt")
    told(wheelleg("play", "latest", "--checkpoint", "nowhere.pt"), "nowhere.pt")
    for path in run.checkpoints():
        path.unlink()
    told(wheelleg("play", "latest"), "no checkpoint")


@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"format": 99}'])
def test_a_run_with_a_broken_manifest_is_told(run, content):
    (run.path / "manifest.json").write_text(content)
    told(wheelleg("play", run.path), "manifest")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("env.num_evns=4", ["env.num_evns", "override", "did you mean 'env.num_envs'?"]),
        ("env.num_envs=0", ["env.num_envs", "at least 1"]),
        ("robot=physical", ["robot", "config groups can only be selected for a new run"]),
        ("seed=1,2", ["seed", "one value"]),
        ("seed", ["seed", "key=value"]),
    ],
)
def test_a_wrong_override_is_told(run, override, words):
    told(wheelleg("play", "latest", override), *words)
    assert not run.play.exists()
