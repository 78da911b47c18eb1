from __future__ import annotations

import json
from pathlib import Path

import pytest
from jobs.replays import change_manifest
from jobs.small import SMALL, cache_of, copied, only_run, succeed, wheelleg
from refused import refusal

from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> dict[str, RunDirectory]:
    """Trainings that differ from the shared training in one setting each."""
    runs = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        one = [*SMALL, "agent.max_iterations=1"]
        changed = {"seed": [*one, "seed=1"], "weight": [*one, "env.rewards.alive.weight=4.0"]}
        for name, words in {"again": SMALL, **changed}.items():
            root = tmp_path_factory.mktemp(name) / "runs"
            succeed("train", *words, f"run.root={root}")
            runs[name] = RunDirectory.open(only_run(root), root)
    return runs


@pytest.fixture
def run(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return copied(trained, tmp_path)


def verify(*words: str | Path) -> tuple[int, dict]:
    said, plain = wheelleg("verify", *words, "--json"), wheelleg("verify", *words)
    document = json.loads(said.out)
    assert (said.err, plain.err, said.status) == ("", "", plain.status)
    verdict = [line for line in plain.out.splitlines() if not line.startswith(" ")][-1]
    assert verdict.startswith(document["verdict"] + ": ")
    return said.status, document


def test_a_training_is_sound_until_a_byte_changes(run):
    status, found = verify("latest")
    assert (status, found["verdict"]) == (0, "sound")
    states = {check["name"]: check["state"] for check in found["checks"]}
    assert states == dict.fromkeys(states, "ok"), found
    (checkpoints,) = [check for check in found["checks"] if check["name"] == "checkpoints"]
    assert checkpoints["text"].startswith("3 files; 3 agree")
    data = bytearray((run.path / "model_1.pt").read_bytes())
    data[len(data) // 2] ^= 1
    (run.path / "model_1.pt").write_bytes(data)
    status, found = verify(run.path)
    assert (status, found["verdict"]) == (1, "damaged")


def test_a_recording_that_could_not_be_merged_is_reported_and_the_run_is_sound(tmp_path, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        patch.setattr("wheelleg_exp.recording.rerun_program.rerun_program", lambda: str(tmp_path / "none"))
        said = wheelleg("train", *SMALL, "agent.max_iterations=1", f"run.root={tmp_path / 'runs'}")
    assert said.status == 0
    (warning,) = [line for line in (said.out + said.err).splitlines() if line.startswith("warning: the recording")]
    assert "Rerun's program is missing" in warning
    (path,) = (tmp_path / "runs" / "stand").iterdir()
    assert json.loads((path / "manifest.json").read_text())["recording_unfinished"] == "Rerun's program is missing"
    status, found = verify(path)
    assert (status, found["verdict"]) == (0, "sound")
    (check,) = [check for check in found["checks"] if check["name"] == "recording"]
    assert check["state"] == "note"
    assert "(Rerun's program is missing)" in check["notes"][0]
    assert wheelleg("inspect", path, "--repair").status == 0  # as it advises
    again = wheelleg("resume", path, "agent.max_iterations=2")
    assert again.status == 0, again.err
    assert json.loads((path / "manifest.json").read_text())["recording_unfinished"] is None
    assert "--repair" not in wheelleg("verify", path).out


def test_the_same_training_twice_is_identical(trained, others):
    status, found = verify(trained.run.path, others["again"].path)
    assert (status, found["verdict"], found["first_divergence"]) == (0, "identical", None)
    states = {name: part["state"] for name, part in found["parts"].items()}
    assert states == dict.fromkeys(states, "equal"), found["parts"]


def test_another_seed_or_weight_is_different_and_reported_by_its_key(trained, others):
    status, found = verify(trained.run.path, others["weight"].path)
    assert (status, found["verdict"]) == (1, "different")
    first = found["first_divergence"]
    assert (first["name"], first["a"], first["b"]) == ("env.rewards.alive.weight", 5.0, 4.0)
    status, found = verify(trained.run.path, others["seed"].path)
    assert (status, found["verdict"]) == (1, "different")
    first = found["first_divergence"]
    assert (first["part"], first["name"], first["details"]["numbers"]["iteration"]) == ("settings", "seed", 0)
    assert {"parameters", "environment", "streams"} <= set(first["details"]["numbers"]["details"]["digests"])


def test_the_first_iterations_alone_can_be_compared(trained, others, run):
    lines = run.iterations.read_text().splitlines()
    run.iterations.write_text("".join(line + "\n" for line in lines[:2]))
    change_manifest(run.path)
    assert verify(run.path, others["again"].path)[0] == 1
    assert verify(run.path, others["again"].path, "--common")[0] == 0
    assert verify(run.path, others["again"].path, "--iterations", "2")[0] == 0


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["nothing"], "there is no run 'nothing'"),
        (["."], "it has no manifest.json"),
        (["latest", "latest"], "the two runs are the same run"),
        (["latest", "--common"], "one was given"),
        (["latest", "latest", "--iterations", "0"], "no iteration is selected for the comparison"),
        ([], "RUN"),
    ],
)
def test_wrong_input_is_refused(run, words, expected):
    assert expected in refusal("verify", *words)
