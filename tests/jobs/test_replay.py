"""``wheelleg replay``: the run again from its snapshot alone, with the code that it was made with, wherever it is."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import tempfile
from pathlib import Path
from threading import Event, Thread

import pytest
from patience import wait_until

from jobs.replays import ITERATIONS, LEANING, TERM, change_manifest, commit, digests, git, make_checkout, train
from jobs.small import Words, copied, manifest, wheelleg
from wheelleg_exp.run.run_lock import this_process
from wheelleg_exp.run.source_snapshot import RECORD_NAME

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("forks")]

PROJECT = """[project]
name = "lab"
version = "0.1.0"
[project.entry-points."wheelleg_exp.packages"]
lab_terms = "lab_terms"
"""
PROJECT_TASK = LEANING.replace("- stand", "- leaning").replace("name: leaning", "name: lab_stand")
PROJECT_TASK = PROJECT_TASK.replace("{leaning: {_target_: wheelleg_exp.mdp.leaning", "{lab: {_target_: lab_terms")


@pytest.fixture(scope="module")
def place(trained, tmp_path_factory):
    """Return a folder with a run, and fresh clones of its three dirty repositories; all that it was made of is gone."""
    place = tmp_path_factory.mktemp("replay")
    checkout, lab, helpers = make_checkout(place / "theirs"), place / "lab", place / "helpers"
    (checkout / "configs" / "task" / "leaning.yaml").write_text(LEANING)
    (checkout / "wheelleg_exp" / "mdp" / "leaning.py").write_text(TERM)
    with (checkout / "configs" / "task" / "stand.yaml").open("a") as file:
        file.write("# a note\n")
    for folder in (lab / "configs" / "task", lab / "lab_terms", helpers):
        folder.mkdir(parents=True)
    (lab / "pyproject.toml").write_text(PROJECT)
    (lab / "configs" / "task" / "lab_stand.yaml").write_text(PROJECT_TASK)
    (lab / "lab_terms" / "__init__.py").write_text("")
    commit(lab)
    text = "from replay_helper import FACTOR\n" + TERM.replace("1.25", "FACTOR")
    (lab / "lab_terms" / "__init__.py").write_text(text)
    (helpers / "replay_helper.py").write_text("FACTOR = 1.25\n")
    commit(helpers)
    words = ("task=lab_stand", "run.name=first", f"init_from={copied(trained, place).path}")
    run = train(checkout, *words, root=checkout / "runs", options=("--config-dir", str(lab)), path=helpers)
    shutil.move(run, place / "handed_over")
    for folder in (checkout, lab, helpers):
        git(place, "clone", "-q", str(folder), f"{folder}_clone")
        shutil.rmtree(folder)
    shutil.rmtree(place / "runs")
    return place


@pytest.fixture
def clones(place):
    return [place / f"{name}_clone" for name in ("theirs", "lab", "helpers")]


@pytest.fixture
def clone(clones):
    return clones[0]


@pytest.fixture
def run(place, tmp_path):
    return Path(shutil.copytree(place / "handed_over", tmp_path / "copied"))


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    """Return the folder of temporary files, which a test must leave empty."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


def replay(run: Path, *words: str | Path) -> tuple[Words, dict]:
    said = wheelleg("replay", run, "--json", *words)
    return said, json.loads(said.out) if said.out else {}


def of(repositories: list[Path]) -> list[str]:
    return [word for path in repositories for word in ("--repository", str(path))]


def change_record(run: Path, **changes: object) -> None:
    path = run / "source" / RECORD_NAME
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def lines_of(run: Path) -> list[str]:
    return (run / "iterations.jsonl").read_text().splitlines(keepends=True)


def test_a_run_of_dirty_trees_repeats_to_the_bit_on_fresh_clones_elsewhere(place, clones, tmp_path, scratch):
    run = place / "handed_over"
    before = [digests(folder) for folder in (run, *clones)]
    said, found = replay(run, *of(clones))
    assert said.status == 0, said.err
    assert (found["verdict"], found["iterations"], found["all_iterations"]) == ("identical", ITERATIONS, True)
    assert said.err.startswith("replay runs the code of commit ")
    assert "plus the run's patch" in said.err.splitlines()[0]
    assert f"training {ITERATIONS}/{ITERATIONS}" in said.err
    assert found["composed"] == {"equal": True, "difference": None}
    assert [tree["how"] for tree in found["source"]] == ["restored"] * 3
    assert [tree["origin"] for tree in found["source"]] == [str(path) for path in clones]
    assert found["asset"] == {"converted": True, "note": None}
    assert [digests(folder) for folder in (run, *clones)] == before
    assert not list(scratch.glob("wheelleg*"))

    new = Path(found["replay"])
    assert new.parent == tmp_path / "runs" / "replays" / "lab_stand"
    assert new.name.endswith("_0_first_replay")
    for k in range(ITERATIONS):
        assert (new / f"model_{k}.pt").read_bytes() == (run / f"model_{k}.pt").read_bytes(), k
    old, made = manifest(run), manifest(new)
    assert (made["status"], made["replay_of"]) == ("finished", old["id"])
    assert made["init_from"]["kept_sha256"] == old["init_from"]["kept_sha256"]  # The other run is gone.
    assert made["replay"]["snapshot"]["source/source.patch"] == old["files"]["source/source.patch"]["sha256"]
    assert (made["replay"]["asset"], made["replay"]["composed"]) == (found["asset"], found["composed"])
    assert made["additions"][-1]["results"]["verdict"] == "identical"
    records = [json.loads((folder / "source" / RECORD_NAME).read_text()) for folder in (run, new)]
    assert records[0]["tree"] == records[1]["tree"]
    assert "configs/task/leaning.yaml" in records[0]["untracked"]


def test_other_code_in_the_patch_is_found(run, clones, clone, tmp_path, scratch):
    patch = run / "source" / "source.patch"
    forged = patch.read_bytes().replace(b"1.25", b"1.75")
    assert forged != patch.read_bytes()
    other = tmp_path / "other"
    git(tmp_path, "clone", "-q", str(clone), str(other))
    git(other, "apply", "--cached", "-", stdin=forged)
    change_record(run, tree=git(other, "write-tree"), patch_sha256=hashlib.sha256(forged).hexdigest())
    patch.write_bytes(forged)
    identity = json.loads((run / "asset" / "asset.json").read_text())
    identity["sources"] = dict.fromkeys(identity["sources"], "0" * 64)
    (run / "asset" / "asset.json").write_text(json.dumps(identity))
    change_manifest(run)
    said, found = replay(run, *of(clones), "--iterations", "2", "--keep")
    assert said.status == 1, said.err
    assert (found["verdict"], found["iterations"], found["all_iterations"]) == ("different", 2, False)
    assert found["comparison"]["first_divergence"]["iteration"] == 0
    assert found["asset"]["converted"] is False
    assert "is not the recorded one: the replay simulates the saved MJCF" in said.err
    assert manifest(Path(found["replay"]))["status"] == "interrupted"
    kept = Path(found["kept"])
    assert kept.parent.parent == scratch
    (code,) = kept.glob("*/*/wheelleg_exp/mdp/leaning.py")
    assert "1.75" in code.read_text()
    assert [path.name for path in kept.parent.iterdir()] == ["source"]


def test_a_killed_run_is_replayed_as_far_as_it_came(run, clones):
    (run / "iterations.jsonl").write_text("".join(lines_of(run)[:2]) + lines_of(run)[2][:40])
    for name in ("model_2.pt", "exported", "recording.rrd"):
        path = run / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    made = manifest(run)
    snapshot = (".hydra/", "params/", "source/", "asset/", "environment.txt")
    change_manifest(
        run,
        status="running",
        ended=None,
        process=made["process"] | {"boot_id": "another"},
        files={name: entry for name, entry in made["files"].items() if name.startswith(snapshot)},
        versions=made["versions"] | {"torch": "1.0.0", "wheelleg_exp": "0.1.0"},
        environment_variables=made["environment_variables"] | {"OMP_NUM_THREADS": "1", "LD_PRELOAD": "their.so"},
    )
    said, found = replay(run, *of(clones))
    assert "differs: torch was 1.0.0, is " in said.err
    assert "wheelleg_exp was" not in said.err
    assert "OMP_NUM_THREADS" not in said.err
    assert "differs: LD_PRELOAD was their.so, is None" in said.err
    assert said.status == 0, said.err
    assert (found["verdict"], found["iterations"], found["all_iterations"]) == ("identical", 2, True)
    new = Path(found["replay"])
    assert manifest(new)["environment_variables"]["OMP_NUM_THREADS"] == "1"
    assert "LD_PRELOAD" not in manifest(new)["environment_variables"]
    parts = found["comparison"]["parts"]
    assert {parts[name]["state"] for name in ("digests", "scalars", "checkpoints")} == {"equal"}
    assert (new / "model_1.pt").read_bytes() == (run / "model_1.pt").read_bytes()


def test_an_interrupt_reaches_the_training_and_the_source_is_removed(run, clones, tmp_path, scratch):
    line = json.loads(lines_of(run)[-1])
    with (run / "iterations.jsonl").open("a") as file:
        file.writelines(json.dumps({**line, "iteration": k}) + "\n" for k in range(ITERATIONS, 2000))
    over, logs = Event(), "runs/replays/lab_stand/*/iterations.jsonl"

    def interrupt() -> None:
        wait_until(lambda: over.is_set() or any(path.read_text() for path in tmp_path.glob(logs)))
        if not over.is_set():
            os.kill(os.getpid(), signal.SIGINT)

    thread = Thread(target=interrupt)
    thread.start()
    said = wheelleg("replay", run, *of(clones))
    over.set()
    thread.join()
    assert said.status == 130, said.err
    assert "Traceback" not in said.err
    assert not list(scratch.glob("wheelleg*"))
    (new,) = tmp_path.glob("runs/replays/lab_stand/*/manifest.json")
    assert json.loads(new.read_text())["status"] == "interrupted"
    assert os.path.lexists(new.parent / ".lock")
    with pytest.raises(ProcessLookupError):
        os.kill(json.loads(new.read_text())["process"]["pid"], 0)


def refused(run: Path, *words: str | Path) -> str:
    said, _ = replay(run, *words)
    assert said.status == 2, said.err
    assert not Path("runs").exists()
    return said.err


def _change(name):
    return lambda run: (run / name).write_bytes((run / name).read_bytes().replace(b"1", b"2", 1))


SNAPSHOT = (".hydra/config.yaml", "params/env.yaml", "source/source.patch", "asset/robot.xml")
REFUSED = [(_change(name), f"{name} is not what the manifest recorded", ()) for name in SNAPSHOT]
REFUSED += [(lambda run: None, "from 1 to the 3 that the run has", ("--iterations", number)) for number in ("0", "4")]
REFUSED += [
    (lambda run: (run / "source/source_9.patch").touch(), "manifest lacks the file source/source_9.patch", ()),
    (lambda run: (run / "params/agent.yaml").unlink(), "params/agent.yaml is missing", ()),
    (lambda run: change_manifest(run, status="running", process=this_process()), "is still running", ()),
]


@pytest.mark.parametrize(("change", "message", "words"), REFUSED)
def test_a_changed_or_running_run_or_a_wrong_number_of_iterations_is_refused(run, clone, change, message, words):
    change(run)
    assert message in refused(run, "--repository", clone, *words)


def test_a_missing_commit_is_reported_with_the_remedy(run, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    git(elsewhere, "init", "-q")
    said = refused(run, "--repository", elsewhere)
    assert [word for word in ("no repository here contains commit", "--repository") if word not in said] == []
    assert "git fetch" in said


def test_a_source_that_was_not_stored_is_reported(run, clone):
    change_record(run, patch=None, status="patch_too_large", note="the patch has 80 MB")
    change_manifest(run)
    said = refused(run, "--repository", clone)
    assert "source of the run was not captured (patch_too_large): the patch has 80 MB" in said
