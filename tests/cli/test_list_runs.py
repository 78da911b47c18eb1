import json
from datetime import UTC, datetime

import pytest
from jobs.small import wheelleg

from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory

LONG = "a_rather_long_name_that_somebody_gave_to_a_run_so_that_nobody_forgets_what_it_was_about"


@pytest.fixture
def root(tmp_path):
    for number, (status, name) in enumerate((("finished", None), ("failed", LONG), ("interrupted", "b"))):
        now = datetime(2026, 1, 1, number, tzinfo=UTC)
        run = RunDirectory.create(tmp_path / "runs", "stand", number, name, now)
        Manifest.begin(run.path, task="stand", seed=number, command=["wheelleg"], threads={}, now=now)
        scalars = {
            "Train/mean_reward": -1234.567,
            "Train/mean_episode_length": 300.0,
            "Episode_Termination/time_out": 0.5,
        }
        (run.path / "iterations.jsonl").write_text(
            json.dumps({"iteration": 9999, "digests": {}, "scalars": scalars}) + "\n"
        )
        (run.path / "params").mkdir()
        (run.path / "params" / "agent.yaml").write_text("max_iterations: 12000\n")
        (run.path / "model_9950.pt").write_bytes(b"")
        end = datetime(2026, 1, 1, 10, tzinfo=UTC)
        run.manifest().finish(status, {}, "the disk is full" if status == "failed" else None, now=end)
        run.manifest().add("play", results={"survival": 0.9996, "episodes": 2512, "unfinished": 12})
    return tmp_path / "runs"


def test_the_table_shows_the_result_of_each_run_and_fits_a_terminal(root):
    lines = wheelleg("list", "runs", "--root", root).out.splitlines()
    assert max(map(len, lines)) <= 100
    assert " ".join(lines[0].split()) == "id task status done return time-out played took resume"
    assert " ".join(lines[3].split()[2:]) == "finished 10000/12000 -1234.57 50.0% 2499/2500 10h00m from 9950"
    assert "…" in lines[2]
    said = " ".join(" ".join(lines[4:]).split())
    assert ": the disk is full return: mean of the last 100 ended episodes of the training; time-out: share of" in said


def test_columns_that_no_run_fills_leave_their_room_to_the_ids(tmp_path):
    for number, name in enumerate(("stand", "walk"), 1):
        now = datetime(2026, 1, 1, number, tzinfo=UTC)
        run = RunDirectory.create(tmp_path, "walk", number, name, now)
        manifest = Manifest.begin(run.path, task="walk", seed=number, command=["wheelleg"], threads={}, now=now)
        manifest.finish("finished", {}, None, now=now)
        run.manifest().add("evaluation", results={"protocol": "gate_stand", "metrics": {"stand/survival": 0.5}})
    lines = wheelleg("list", "runs", "--root", tmp_path).out.splitlines()
    assert " ".join(lines[0].split()) == "id task status done return time-out evaluated took"
    assert all("gate_stand 50.0%" in line for line in lines[1:3])
    assert [line.split()[0] for line in lines[1:3]] == [run.name for run in sorted((tmp_path / "walk").iterdir())][::-1]


def test_json_contains_everything(root):
    newest = json.loads(wheelleg("list", "runs", "--root", root, "--json").out)[0]
    assert (newest["name"], newest["iterations"], newest["checkpoint"], newest["resumable"]) == ("b", 10000, 9950, True)
    assert (newest["status"], newest["seeds"]) == ("interrupted", [2])
    assert newest["played"] == {"survival": 0.9996, "episodes": 2512, "unfinished": 12}
    assert newest["started"] == "2026-01-01T02:00:00.000000Z"
    assert json.loads(wheelleg("list", "sweeps", "--root", root, "--json").out) == []
    assert wheelleg("list", "sweeps", "--root", root).out.split() == ["id", "status", "jobs", "swept", "took"]
