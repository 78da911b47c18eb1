import json
import subprocess
import sys

import pytest
import yaml
from jobs.small import TINY, wheelleg
from jobs.sweeps import STAND_IN

from wheelleg_exp.jobs import training_job
from wheelleg_exp.jobs.run_sweep import SweepRunner

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_folders")]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["seed=1,2"], ["seed: several values for one run (override seed=1,2)", "-m (--multirun) trains each"]),
        (["seed=range(1,3)", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "hydra.run.dir=x"],
         ["4 mistakes", "seed: several values for one run", "hydra/launcher: this is a setting of a sweep",
          "hydra.launcher.n_jobs: this is a setting of a sweep", "hydra.run.dir: nothing reads this", "run.root=DIR"]),
        (["-m", "seed=1,x", "env.decimation=0"], ["2 mistakes", "override seed=x", "override env.decimation=0"]),
        (["--multirun", "hydra.run.dir=x", "hydra/job_logging=disabled", "hydra.sweep.dir=x", "hydra/launcher=lsf"],
         ["4 mistakes", "hydra.run.dir: nothing reads this", "run.root=DIR", "hydra/job_logging: nothing reads this",
          "hydra.sweep.dir: nothing reads this", "'lsf' is not supported", "one of basic, joblib"]),
    ],
    ids=["one", "all of one run", "a job", "all of a sweep"],
)  # fmt: skip
def test_mistakes_end_with_status_2_and_leave_nothing(tmp_path, words, expected):
    said = wheelleg("train", *words)
    assert (said.status, said.out, [part for part in expected if part not in said.err]) == (2, "", [])
    assert list(tmp_path.iterdir()) == []


# The override run.name determines how a job ends that replaces a training.
PRETENDING = STAND_IN.replace('(what,) = request["overrides"]', 'what = request["overrides"][0].split("=")[1]')


@pytest.fixture
def pretend(monkeypatch):
    monkeypatch.setattr(training_job, "_BOOT", PRETENDING)


@pytest.mark.usefixtures("pretend")
def test_a_failed_job_is_status_3_after_all_others(tmp_path):
    said = wheelleg("train", "-m", "run.name=fail,die,killed,finish", "seed=3")
    assert said.status == 3
    rows = [line.split() for line in said.out.splitlines()[1:5]]
    ends = {"fail": "failed", "die": "failed", "killed": "failed", "finish": "finished"}
    assert [row[:3] for row in rows] == [[str(n), f"run.name={what}", ends[what]] for n, what in enumerate(ends, 1)]
    assert rows[3][-1] == "runs/stand/finish"
    for words in ("1 of 4 jobs finished: runs/sweeps/", "retry: ", " resume --sweep runs/sweeps/"):
        assert words in said.out
    assert "job 1 run.name=fail failed: gone to NaN" in said.err


@pytest.mark.usefixtures("pretend")
def test_json_is_one_document_when_a_job_fails(tmp_path):
    said = wheelleg("train", "-m", "--json", "run.name=finish1,fail")
    document = json.loads(said.out)
    assert (said.status, document["status"]) == (3, "failed")
    assert [job["status"] for job in document["jobs"]] == ["finished", "failed"]
    assert document["jobs"][0]["run"] == str(tmp_path / "runs" / "stand" / "finish1")
    assert [document["sweep"]] == [str(path) for path in (tmp_path / "runs" / "sweeps").iterdir()]
    assert document["command"] == ["wheelleg", "train", "-m", "--json", "run.name=finish1,fail"]


@pytest.mark.usefixtures("pretend")
def test_the_basic_launcher_runs_one_job_at_a_time_whatever_the_machine(tmp_path):
    said = wheelleg("train", "-m", "run.name=finish1,finish2")
    assert said.status == 0
    begun = [line.split()[1] + line.split()[-1] for line in said.err.splitlines() if line.startswith("job ")]
    assert begun == ["1started", "1finished", "2started", "2finished"]
    (index,) = (tmp_path / "runs" / "sweeps").iterdir()
    assert json.loads((index / "sweep.json").read_text())["launcher"] == {"name": "basic", "at_once": 1}


@pytest.mark.usefixtures("pretend")
def test_jobs_with_more_threads_than_cores_cause_a_warning(tmp_path, monkeypatch):
    import joblib

    monkeypatch.setattr(joblib, "cpu_count", lambda: 4)
    words = ["train", "-m", "run.name=finish1,finish2", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    said = wheelleg(*words, "agent.torch_threads=3", "env.sim.nthread=1")
    assert "warning: 2 jobs of 3 threads each share 4 cores; agent.torch_threads=2 env.sim.nthread=2" in said.err
    said = wheelleg(*words, "agent.torch_threads=2", "env.sim.nthread=2")
    assert "warning" not in said.err


@pytest.mark.usefixtures("pretend")
def test_in_a_terminal_every_running_job_has_a_line(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "200")
    said = wheelleg("train", "-m", "run.name=finish1,fail")
    assert said.status == 3
    assert "checking" in said.err
    assert "job 1 run.name=finish1" in said.err
    assert "job 2 run.name=fail failed: gone to NaN" in said.err
    assert "\x1b" not in said.out


@pytest.mark.usefixtures("pretend")
def test_a_sweep_that_is_started_twice_in_a_second_has_two_folders(tmp_path):
    for jobs in ("talk,talk", "talk"):
        said = wheelleg("train", "-m", f"run.name={jobs}", "run.root=elsewhere")
        assert said.status == 0
        assert said.err.count("something") == 1  # A line that several jobs repeat is shown once.
        assert said.err.count("x" * 100) == 1
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["elsewhere"]
    assert len(list((tmp_path / "elsewhere" / "sweeps").glob("*/sweep.json"))) == 2


def test_jobs_find_the_environment_that_a_run_alone_finds():
    code = (
        "import os, sys, types; before = dict(os.environ); from wheelleg_exp.cli import train;"
        "jobs = types.SimpleNamespace(jobs=[0] * 1000, n_jobs=-1, launcher='joblib');"
        "print(train._at_once(jobs) >= 1, dict(os.environ) == before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.usefixtures("pretend")
def test_the_last_lines_list_the_jobs_and_the_next_commands(tmp_path, monkeypatch):
    ended = ("finished", {"Train/mean_reward": 1.5}, None)
    monkeypatch.setattr(SweepRunner, "_outcome", lambda *_: ended)
    words = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    said = wheelleg("train", "-m", "run.name=finish1,finish2", *TINY, *words)
    lines = said.out.splitlines()
    assert lines[0].split() == ["job", "overrides", "status", "return", "run"]
    for number, line in enumerate(lines[1:3], 1):
        name = f"finish{number}"
        assert line.split() == [str(number), f"run.name={name}", "finished", "1.500", f"runs/stand/{name}"]
    assert lines[4].startswith("2 of 2 jobs finished: runs/sweeps/")
    for words in (" --logdir runs/stand", "diff runs/stand/", "play runs/stand/"):
        assert words in said.out
    assert "retry:" not in said.out
    (folder,) = (tmp_path / "runs" / "sweeps").iterdir()
    multirun = yaml.safe_load((folder / "multirun.yaml").read_text())
    assert (multirun["hydra"]["mode"], multirun["hydra"]["launcher"]["n_jobs"]) == ("MULTIRUN", 2)
    assert multirun["hydra"]["sweep"]["dir"] == str(folder)
    assert multirun["hydra"]["overrides"]["task"] == ["run.name=finish1,finish2", *TINY]
