from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import write_json
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.run.run_list import list_runs
from wheelleg_exp.run.timestamps import folder_text

NOW = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


def make(root, jobs=(("seed=1", "a=2"), ("seed=2", "a=2"))) -> SweepIndex:
    pairs = [(overrides, overrides[:1]) for overrides in jobs]
    facts = {"name": "basic", "at_once": 1}
    return SweepIndex.create(root, command=["wheelleg", "train"], launcher=facts, jobs=pairs, now=NOW)


def test_a_new_sweep_has_its_own_folder_below_sweeps_and_all_jobs_wait(tmp_path):
    first, second = make(tmp_path), make(tmp_path)
    assert (first.folder, second.folder.name) == (tmp_path / "sweeps" / folder_text(NOW), first.folder.name + "-2")
    data = json.loads(first.path.read_text())
    assert (data["format"], data["status"], data["ended"]) == (1, "running", None)
    assert data["command"] == ["wheelleg", "train"]
    assert [(job["number"], job["status"], job["overrides"], job["swept"]) for job in data["jobs"]] == [
        (1, "waiting", ["seed=1", "a=2"], ["seed=1"]),
        (2, "waiting", ["seed=2", "a=2"], ["seed=2"]),
    ]


def test_what_is_recorded_is_read_back(tmp_path, make_run):
    index = make(tmp_path / "runs")
    run = make_run("stand", 1)
    index.update(1, run=index.relative(run.path), status="finished", results={"iterations": 3})
    again = SweepIndex.load(index.folder)
    assert (again.data, again.jobs[0]["run"]) == (index.data, f"../../stand/{run.id}")
    assert again.run_of(again.jobs[0]) == run.path
    assert again.run_of(again.jobs[1]) is None
    (tmp_path / "runs").rename(tmp_path / "moved")
    again = SweepIndex.load(tmp_path / "moved" / "sweeps" / index.folder.name)
    found = again.run_of(again.jobs[0])
    assert RunDirectory.open(found, tmp_path / "moved").path == found


def test_a_job_that_nobody_saw_end_is_interrupted(tmp_path):
    index = make(tmp_path)
    index.update(1, status="running")
    index.finish("interrupted")
    assert [job["status"] for job in SweepIndex.load(index.folder).jobs] == ["interrupted", "waiting"]
    assert index.data["ended"] is not None


def test_a_sweep_is_no_run(tmp_path, make_run):
    run = make_run("stand", 1)
    index = make(tmp_path / "runs")
    write_json(index.folder / "manifest.json", {})  # A sweep with a manifest is still not a run.
    assert [listed.path for listed in list_runs(tmp_path / "runs")] == [run.path]
    assert RunDirectory.open("latest", tmp_path / "runs").path == run.path


REFUSED = [(None, "cannot read"), ("{", "broken JSON"), ("[]", "is not the index of a sweep")]
REFUSED += [('{"format": 1, "status": "failed", "jobs": [{"number": 1}]}', "the key 'working_directory' is missing")]
REFUSED += [('{"format": 1}', "is not the index of a"), ('{"format": 2, "jobs": []}', "sweep format 2 is unknown")]


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_a_missing_or_invalid_index_is_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(RunDirectoryError, match=message):
        SweepIndex.load(tmp_path)
