from __future__ import annotations

import json
import subprocess
import sys
import time
from datetime import UTC, datetime, timedelta

import pytest

from wheelleg_exp.run.listing import list_runs
from wheelleg_exp.run.process import is_alive, this_process

START = datetime(2026, 1, 1, 12, tzinfo=UTC)


def set_process(run, **changes):
    path = run.path / "manifest.json"
    data = json.loads(path.read_text())
    data["process"].update(changes)
    path.write_text(json.dumps(data))


@pytest.fixture
def dead_pid():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_no_root_is_no_runs(tmp_path):
    assert list_runs(tmp_path / "runs") == []


def test_runs_of_all_tasks_are_listed_newest_first(make_run, tmp_path):
    a = make_run("walk", 1, now=START)
    b = make_run("stand", 2, now=START + timedelta(hours=2))
    c = make_run("walk", 3, now=START + timedelta(hours=1))
    c.manifest().finish("finished", {"survival": 1.0})
    (tmp_path / "runs" / "walk" / "notes").mkdir()
    (tmp_path / "runs" / "README.md").write_text("")
    found = list_runs(tmp_path / "runs")
    assert [s.id for s in found] == [b.id, c.id, a.id]
    assert [s.task for s in found] == ["stand", "walk", "walk"]
    assert [s.status for s in found] == ["running", "finished", "running"]
    assert found[1].results == {"survival": 1.0}
    assert found[1].seeds == (3,)


def test_a_run_whose_process_is_gone_has_crashed(make_run, tmp_path, dead_pid):
    set_process(make_run(), pid=dead_pid)
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["crashed"]


def test_a_pid_that_now_belongs_to_a_later_process_has_crashed(make_run, tmp_path):
    set_process(make_run(), start_ticks=1)  # our own pid, but another start
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["crashed"]


def test_a_run_from_before_a_reboot_has_crashed(make_run, tmp_path):
    set_process(make_run(), boot_id="00000000-0000-0000-0000-000000000000")
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["crashed"]


def test_a_run_on_another_host_is_believed(make_run, tmp_path, dead_pid):
    set_process(make_run(), pid=dead_pid, host="elsewhere")
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["running"]


def test_a_finished_run_has_not_crashed(make_run, tmp_path, dead_pid):
    run = make_run()
    run.manifest().finish("finished")
    set_process(run, pid=dead_pid)
    assert [s.status for s in list_runs(tmp_path / "runs")] == ["finished"]


def test_a_damaged_run_is_listed_with_its_problem(make_run, tmp_path):
    make_run(now=START)
    damaged = make_run(now=START + timedelta(hours=1))
    (damaged.path / "manifest.json").write_text("{")
    first, second = list_runs(tmp_path / "runs")
    assert (first.status, second.status) == ("damaged", "running")
    assert "broken JSON" in first.problem
    # the name tells whole seconds of local time
    assert first.started == START + timedelta(hours=1)


def test_a_zombie_is_not_alive():
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    recorded = {k: v for k, v in this_process().items() if k != "start_ticks"}
    recorded["pid"] = process.pid
    assert is_alive(recorded) is True
    process.stdin.close()
    deadline = time.monotonic() + 5
    while is_alive(recorded) and time.monotonic() < deadline:  # ended, and not yet waited for
        time.sleep(0.01)
    assert is_alive(recorded) is False
    process.wait()
