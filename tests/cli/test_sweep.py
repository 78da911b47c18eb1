import json
import subprocess
import sys

import pytest
import yaml
from jobs.small import SMALL, wheelleg
from jobs.sweeps import STAND_IN, swept_once

from wheelleg_exp.jobs import training_job

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_folders")]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    return swept_once(tmp_path_factory)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["seed=1,2"], ["seed: several values for one run (override seed=1,2)", "-m (--multirun) trains each"]),
        (["seed=range(1,3)"], ["seed: several values for one run", "-m (--multirun)"]),
        (["hydra/launcher=joblib"], ["hydra/launcher: this is a setting of a sweep", "-m (--multirun)"]),
        (["hydra.launcher.n_jobs=2"], ["hydra.launcher.n_jobs: this is a setting of a sweep", "-m (--multirun)"]),
        (["-m", "seed=1,x", "env.decimation=0"], ["2 mistakes", "override seed=x", "override env.decimation=0"]),
        (["hydra.run.dir=x"], ["hydra.run.dir: nothing reads this", "run.root=DIR"]),
        (["-m", "seed=1,2", "hydra.run.dir=x"], ["hydra.run.dir: nothing reads this", "run.root=DIR"]),
        (["-m", "seed=1,2", "hydra/job_logging=disabled"], ["hydra/job_logging: nothing reads this"]),
        (["--multirun", "hydra.sweep.dir=x"], ["hydra.sweep.dir: nothing reads this", "run.root"]),
        (["-m", "hydra/launcher=lsf"], ["'lsf' is not supported", "one of basic, joblib"]),
    ],
    ids=lambda value: " ".join(value) if "=" in value[-1] and " " not in value[-1] else "",
)
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
    said = wheelleg("train", "-m", "run.name=fail,finish1,die,killed,finish2", "seed=3")
    assert said.status == 3
    rows = [line.split() for line in said.out.splitlines()[1:6]]
    ends = {"fail": "failed", "finish1": "finished", "die": "failed", "killed": "failed", "finish2": "finished"}
    assert [row[:3] for row in rows] == [[str(n), f"run.name={what}", ends[what]] for n, what in enumerate(ends, 1)]
    assert rows[1][-1] == "runs/stand/finish1"
    for words in ("2 of 5 jobs finished: runs/sweeps/", "retry: ", " train run.name=fail seed=3"):
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
    said = wheelleg("train", "-m", "run.name=finish1,finish2,finish3")
    assert said.status == 0
    begun = [line.split()[1] + line.split()[-1] for line in said.err.splitlines() if line.startswith("job ")]
    assert begun == ["1started", "1finished", "2started", "2finished", "3started", "3finished"]
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
    said = wheelleg("train", "-m", "run.name=finish1,fail,finish3")
    assert said.status == 3
    assert "checking" in said.err
    assert "job 1 run.name=finish1" in said.err
    assert "job 2 run.name=fail failed: gone to NaN" in said.err
    assert "\x1b" not in said.out


@pytest.mark.usefixtures("pretend")
def test_a_sweep_that_is_started_twice_in_a_second_has_two_folders(tmp_path):
    for _ in range(2):
        said = wheelleg("train", "-m", "run.name=talk,talk", "run.root=elsewhere")
        assert said.status == 0
        assert said.err.count("something") == 1  # A line that several jobs repeat is shown once.
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["elsewhere"]
    assert len(list((tmp_path / "elsewhere" / "sweeps").glob("*/sweep.json"))) == 2


def test_jobs_find_the_environment_that_a_run_alone_finds():
    code = (
        "import os, sys, types; before = dict(os.environ); from wheelleg_exp.cli import train_sweep;"
        "jobs = types.SimpleNamespace(jobs=[0] * 1000, n_jobs=-1, launcher='joblib');"
        "print(train_sweep._at_once(jobs) >= 1, dict(os.environ) == before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]


@pytest.mark.train
def test_the_last_lines_list_the_jobs_and_the_next_commands(swept):
    lines = swept.said.out.splitlines()
    assert lines[0].split() == ["job", "overrides", "status", "return", "run"]
    for line, job in zip(lines[1:3], swept.index.jobs, strict=True):
        run = swept.index.run_of(job)
        figure = f"{job['results']['Train/mean_reward']:.3f}"
        assert line.split() == [str(job["number"]), *job["swept"], "finished", figure, f"runs/stand/{run.name}"]
    assert lines[4].startswith("2 of 2 jobs finished: runs/sweeps/")
    for words in (" --logdir runs/stand", "diff runs/stand/", "play runs/stand/"):
        assert words in swept.said.out
    assert "retry:" not in swept.said.out
    # The warnings of the physics check are shown once for all jobs.
    assert " ".join(swept.said.err.split()).count("check.silence.episode_end silences it") == 1
    said = wheelleg("list", "runs", "--root", swept.root, "--json")
    listed = {row["path"]: (row["status"], row["task"]) for row in json.loads(said.out)}
    assert [listed[str(swept.index.run_of(job))] for job in swept.index.jobs] == [("finished", "stand")] * 2


@pytest.mark.train
def test_multirun_yaml_names_the_sweep_and_its_folder(swept):
    multirun = yaml.safe_load((swept.folder / "multirun.yaml").read_text())
    assert (multirun["hydra"]["mode"], multirun["hydra"]["launcher"]["n_jobs"]) == ("MULTIRUN", 2)
    assert multirun["hydra"]["sweep"]["dir"] == str(swept.folder)
    assert multirun["hydra"]["overrides"]["task"] == ["seed=0,1", *SMALL, "run.name=small"]
