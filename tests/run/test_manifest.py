import hashlib
import json
import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta

import mujoco
import pytest

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.manifest import Manifest


def begin(directory, **keywords):
    facts = {"task": "walk", "seed": 3, "command": ["wheelleg", "train"], "threads": {"torch": 2}}
    return Manifest.begin(directory, **{**facts, **keywords})


def on_disk(directory):
    return json.loads((directory / "manifest.json").read_text())


def test_a_new_run_has_the_status_running_and_all_its_inputs(tmp_path, monkeypatch):
    monkeypatch.setenv("MKL_CBWR", "AVX2,STRICT")
    monkeypatch.setenv("WHEELLEG_API_TOKEN", "hidden")
    begin(tmp_path)
    data = on_disk(tmp_path)
    assert (data["format"], data["status"], data["command"]) == (2, "running", ["wheelleg", "train"])
    assert (data["seeds"], data["threads"], data["process"]["pid"]) == ([3], {"torch": 2}, os.getpid())
    assert data["environment_variables"]["MKL_CBWR"] == "AVX2,STRICT"
    assert "hidden" not in json.dumps(data)
    assert data["versions"]["mujoco-core"] == mujoco.mj_versionString()
    assert data["ended"] is None
    started = datetime.fromisoformat(data["started"])
    assert started.utcoffset() == timedelta(0)
    assert abs(datetime.now(UTC) - started) < timedelta(minutes=1)


def test_a_second_run_in_the_directory_and_a_file_outside_of_it_are_refused(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    (tmp_path / "x").write_text("")
    manifest = begin(run)
    for message, refused in (
        ("already contains a run", lambda: begin(run)),
        ("outside", lambda: manifest.add("play", [tmp_path / "x"])),
        ("cannot read", lambda: manifest.add("play", [run / "missing"])),
    ):
        with pytest.raises(RunDirectoryError, match=message):
            refused()
    assert on_disk(run)["additions"] == []


def test_the_end_lists_every_other_file_with_its_digest(tmp_path):
    for folder in ("params", ".hydra"):
        (tmp_path / folder).mkdir()
    listed = {".hydra/config.yaml": b"", "model_9.pt": b"weights", "params/env.yaml": b"a: 1\n"}
    (tmp_path / "params" / "env.yaml").write_bytes(listed["params/env.yaml"])
    manifest = begin(tmp_path)
    assert list(on_disk(tmp_path)["files"]) == ["params/env.yaml"]
    for name, content in {**listed, ".model_19.pt.0123.tmp": b"half", ".lock": b"{}"}.items():
        (tmp_path / name).write_bytes(content)
    manifest.finish("finished", {"reward": 1.5})
    data = on_disk(tmp_path)
    assert (data["status"], data["results"]) == ("finished", {"reward": 1.5})
    assert data["ended"] >= data["started"]
    expected = {n: {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)} for n, data in listed.items()}
    assert data["files"] == expected


@pytest.mark.parametrize(
    ("raised", "status"), [(None, "finished"), (KeyboardInterrupt(), "interrupted"), (OSError("x"), "failed")]
)
def test_the_end_is_written_however_the_run_ends(tmp_path, raised, status):
    manifest = begin(tmp_path)
    with nullcontext() if raised is None else pytest.raises(type(raised)), manifest.finishing() as results:
        results["iterations"] = 4
        if raised is not None:
            raise raised
    data = on_disk(tmp_path)
    assert (data["status"], data["results"]) == (status, {"iterations": 4})
    assert data["error"] == (None if raised is None else {"type": type(raised).__name__, "message": str(raised)})


def test_the_first_error_is_raised_when_the_end_cannot_be_written(tmp_path, monkeypatch):
    manifest = begin(tmp_path)
    monkeypatch.setattr("wheelleg_exp.run.manifest.write_text", lambda *_: (_ for _ in ()).throw(OSError("disk")))
    with pytest.raises(ValueError, match="first") as caught, manifest.finishing():
        raise ValueError("first")
    assert "disk" in caught.value.__notes__[0]


def test_a_later_command_gets_its_own_entry(tmp_path):
    begin(tmp_path).finish("finished")
    (tmp_path / "play").mkdir()
    (tmp_path / "play" / "a.rrd").write_bytes(b"abc")
    before = on_disk(tmp_path)
    words = ["wheelleg", "play"]
    Manifest.load(tmp_path).add("play", [tmp_path / "play" / "a.rrd"], {"survival": 1.0}, command=words)
    after = on_disk(tmp_path)
    (entry,) = after["additions"]
    assert (entry["kind"], entry["command"], entry["results"]) == ("play", words, {"survival": 1.0})
    assert entry["files"] == {"play/a.rrd": {"sha256": hashlib.sha256(b"abc").hexdigest(), "size": 3}}
    rest = [{k: v for k, v in data.items() if k not in ("additions", "sha256")} for data in (after, before)]
    assert rest[0] == rest[1]


def test_additions_at_the_same_time_are_all_recorded_and_survive_the_end_of_the_run(tmp_path):
    manifest = begin(tmp_path)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda i: Manifest.load(tmp_path).add(f"k{i}"), range(8)))
    assert sorted(entry["kind"] for entry in on_disk(tmp_path)["additions"]) == [f"k{i}" for i in range(8)]
    manifest.finish("finished")
    assert sorted(entry["kind"] for entry in on_disk(tmp_path)["additions"]) == [f"k{i}" for i in range(8)]


def test_changed_missing_and_unlisted_files_are_found_by_comparison_with_their_newest_record(tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / name).write_text(name)
    manifest = begin(tmp_path)
    manifest.finish("finished")
    assert not manifest.compare_files()
    for content in ("one", "two"):
        (tmp_path / "policy.onnx").write_text(content)
        manifest.add("export", [tmp_path / "policy.onnx"])
    assert not manifest.compare_files()
    manifest.restart(command=["wheelleg", "resume"], threads={})
    (tmp_path / "policy.onnx").write_text("three")
    manifest.finish("finished")
    assert not manifest.compare_files()
    (tmp_path / "a").write_text("A")
    (tmp_path / "b").unlink()
    (tmp_path / "d").write_text("d")
    found = Manifest.load(tmp_path).compare_files()
    assert (found.changed, found.missing, found.unlisted) == (["a"], ["b"], ["d"])


def test_a_resume_preserves_the_history_of_the_run(tmp_path):
    (tmp_path / "params").mkdir()
    (tmp_path / "params" / "env.yaml").write_text("a: 1\n")
    manifest = begin(tmp_path)
    (tmp_path / "iterations.jsonl").write_text("{}\n")
    manifest.finish("interrupted", {"iterations": 5})
    first = on_disk(tmp_path)
    manifest.restart(command=["wheelleg", "resume", "x"], threads={"torch": 1}, from_iteration=4)
    data = on_disk(tmp_path)
    assert data["status"] == "running"
    assert data["ended"] is None
    # The resume rewrites the iteration log.
    assert (data["started"], list(data["files"])) == (first["started"], ["params/env.yaml"])
    (resume,) = data["resumes"]
    assert (resume["from_iteration"], resume["command"]) == (4, ["wheelleg", "resume", "x"])
    assert (resume["before"]["status"], resume["before"]["files"]) == ("interrupted", first["files"])
    assert resume["before"]["threads"] == {"torch": 2}
