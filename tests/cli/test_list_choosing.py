import json
from datetime import UTC, datetime

import pytest
import yaml
from jobs.small import wheelleg
from refused import refusal

from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import SweepIndex

# The seed, gamma, and return of each run.
RUNS = ((1, 0.9, 3.0), (2, 0.9, 5.0), (1, 0.99, 10.0), (2, 0.99, None))


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = tmp_path / "runs"
    overrides = [[f"seed={seed}", f"agent.algorithm.gamma={gamma}"] for seed, gamma, _ in RUNS]
    index = SweepIndex.create(
        root, command=[], launcher={"name": "basic", "at_once": 1}, jobs=[(words, words) for words in overrides]
    )
    for number, (seed, gamma, figure) in enumerate(RUNS, 1):
        index.update(number, run=index.relative(make(root, number, seed, gamma, figure, "finished")))
    make(root, 0, 7, 0.5, -2.0, "failed")
    return root


def make(root, hour, seed, gamma, figure, status):
    now = datetime(2026, 1, 1, hour, tzinfo=UTC)
    run = RunDirectory.create(root, "stand", seed, None if status == "finished" else "broken", now)
    Manifest.begin(run.path, task="stand", seed=seed, command=[], threads={}, now=now)
    scalars = {} if figure is None else {"Train/mean_reward": figure}
    (run.path / "iterations.jsonl").write_text(json.dumps({"iteration": 9, "digests": {}, "scalars": scalars}) + "\n")
    (run.path / ".hydra").mkdir()
    (run.path / ".hydra" / "config.yaml").write_text(yaml.safe_dump({"agent": {"algorithm": {"gamma": gamma}}}))
    run.manifest().finish(status, {}, None, now=now)
    return run.path


def listed(*words):
    said = wheelleg("list", "runs", *words, "--json")
    assert said.status == 0, said.err
    return [run["figures"].get("return", f"seed {run['seeds'][0]}") for run in json.loads(said.out)]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), ["seed 2", 10, 5, 3, -2]),  # the newest first
        (("--sort", "return"), [10, 5, 3, -2, "seed 2"]),
        (("--sort", "return", "--reverse"), [-2, 3, 5, 10, "seed 2"]),
        (("--sort", "agent.algorithm.gamma", "--reverse"), [-2, 5, 3, "seed 2", 10]),
        (("--filter", "status=finished", "seed=2"), ["seed 2", 5]),
        (("--filter", "status!=finished"), [-2]),
        (("--filter", "return>=3", "return<10"), [5, 3]),
        (("--filter", "agent.algorithm.gamma=0.990"), ["seed 2", 10]),
        (("--filter", "name=bro*"), [-2]),
        (("--filter", "name=null"), ["seed 2", 10, 5, 3]),
        (("--filter", "started>2027"), []),  # A year is the start of a date.
        (("--sweep", "latest", "--sort", "return"), [10, 5, 3, "seed 2"]),
        (("--sweep", "latest", "--filter", "seed=1"), [10, 3]),
    ],
)
def test_runs_are_chosen_and_ordered(root, words, expected):
    assert listed(*words) == expected


def test_a_sweeps_runs_show_what_differs(root):
    lines = wheelleg("list", "runs", "--sweep", "latest", "--sort", "return").out.splitlines()
    assert lines[0].split()[:4] == ["id", "seed", "gamma", "status"]
    assert lines[1].split()[1:4] == ["1", "0.99", "finished"]
    assert max(map(len, lines)) <= 100
    # All finished runs belong to the sweep.
    assert wheelleg("list", "runs", "--filter", "status=finished").out.splitlines()[0] == lines[0]
    assert "gamma" not in wheelleg("list", "runs").out
    newest, *_, oldest = json.loads(wheelleg("list", "runs", "--json").out)
    (sweep,) = (root / "sweeps").iterdir()
    assert (newest["sweep"], newest["swept"]) == (sweep.name, {"seed": "2", "agent.algorithm.gamma": "0.99"})
    assert (oldest["sweep"], oldest["swept"]) == (None, {})
    (sweep / "sweep.json").write_text("{")  # A damaged sweep hides no run.
    assert len(listed()) == 5


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("runs", "--filter", "statsu=finished"), ["no run has 'statsu'", "did you mean 'status'"]),
        (("runs", "--filter", "finished"), ["'finished' is not a valid condition on runs", "KEY=VALUE"]),
        (("runs", "--filter", "return>high"), ["'high' is not a number"]),
        (("runs", "--filter", "status<5"), ["'status' is text, such as 'finished', and 5 is a number", "status=TEXT"]),
        (("runs", "--sort", "retrun"), ["no run has 'retrun'", "did you mean 'return'"]),
        (("runs", "--sweep", "yesterday"), ["there is no sweep 'yesterday'", "'latest', or one of 20"]),
        (("tasks", "--sort", "task"), ["apply only to the list of runs"]),
        (("runs", "run.root=here"), ["run.root=here: 'runs' has no groups", "--root"]),
    ],
)
def test_a_wrong_choice_is_refused_in_one_message(root, words, expected):
    message = refusal("list", *words)
    assert [text for text in expected if text not in message] == []


@pytest.mark.parametrize(("words", "of"), [((), 5), (("--sweep", "latest"), 4)])
def test_an_empty_list_is_reported(root, words, of):
    said = wheelleg("list", "runs", "--filter", "return>1e3", *words)
    assert (said.status, said.out) == (0, f"no run of {of} matches\n")
