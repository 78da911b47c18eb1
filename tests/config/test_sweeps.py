from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from hydra._internal.callbacks import Callbacks
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import create_config_search_path
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.types import HydraContext, RunMode
from omegaconf import OmegaConf

from wheelleg_exp.config.composing import compose_sweep as sweep
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.compose_sweep import compose_sweep, digest_of
from wheelleg_exp.config.composing.config_loader import hydra_globals
from wheelleg_exp.config.config_errors import parts
from wheelleg_exp.errors import ConfigError

pytestmark = pytest.mark.slow

JOBLIB = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]


class _Recorder:
    """A Hydra launcher that records the jobs instead of launching them."""

    def __init__(self) -> None:
        self.jobs: list[list[str]] = []

    def launch(self, job_overrides, initial_job_idx):
        self.jobs += [list(job) for job in job_overrides]
        return []


def _jobs_of_hydra(stock: Path, texts: list[str]) -> list[list[str]]:
    """Return the jobs that Hydra's own sweeper launches."""
    with hydra_globals():
        from hydra._internal.core_plugins.basic_sweeper import BasicSweeper

        loader = ConfigLoaderImpl(create_config_search_path(str(stock)))
        words = [*texts, f"hydra.sweep.dir={stock.parent / 'multirun'}", "hydra.mode=MULTIRUN"]
        config = loader.load_configuration("train", words, RunMode.MULTIRUN, from_shell=False)
        sweeper = BasicSweeper(max_batch_size=None, params=config.hydra.sweeper.params)
        sweeper.config, sweeper.launcher = config, _Recorder()
        sweeper.validate_batch_is_legal = lambda batch: None
        sweeper.hydra_context = HydraContext(config_loader=loader, callbacks=Callbacks())
        sweeper.sweep(list(config.hydra.overrides.task))
        return sweeper.launcher.jobs


def _meaning(overrides) -> list[tuple]:
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    return [(o.type, o.key_or_group, o.package, repr(o.value())) for o in parsed]


@pytest.fixture
def unchecked(monkeypatch):
    empty = SimpleNamespace(config={}, hydra_files=lambda: {"config.yaml": ""})
    monkeypatch.setattr(sweep, "find_mistakes", lambda overrides, **_: (empty, []))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "texts",
    [
        ["seed=1,2,3"],
        ["seed=choice(1,2)", "task=stand,walk", "env.rewards.alive.weight=1.0,2.5", "env.scene.spacing=float(1,2)"],
        ["task=glob([st*,w*],exclude=w*)", "seed=sort(3,1,2)", "agent.max_iterations=sort(range(1,4),reverse=true)"],
        ["run.name=null,a,b_c", "~env.events.push", "++seed=5,6", "env.rewards.height.target_height=1e-2,.5",
         "+env.rewards.more={_target_:shelf_terms.alive,weight:1.0},{_target_:shelf_terms.alive,weight:2.0}"],
        ["seed=1,1"],
        ["run.name=a", "seed=1,2", "run.name=b"],
    ],
    ids=lambda texts: " ".join(texts),
)  # fmt: skip
def test_jobs_are_those_of_hydra_in_its_order(stock, texts):
    found = compose_sweep(texts)
    assert [_meaning(job.overrides) for job in found.jobs] == [_meaning(job) for job in _jobs_of_hydra(stock, texts)]


@pytest.mark.usefixtures("unchecked")
def test_jobs_given_by_the_config_files_are_hydras_too(stock, edit):
    text = "seed: 1\n"
    edit("train.yaml", text, text + "hydra: {sweeper: {params: {seed: '1,2', run.name: 'a,b'}}}\n")
    texts = ["run.name=c,d"]
    jobs = [list(job.overrides) for job in compose_sweep(texts).jobs]
    assert jobs == [[f"seed={seed}", f"run.name={name}"] for seed in (1, 2) for name in "cd"]
    assert jobs == _jobs_of_hydra(stock, texts)


@pytest.mark.usefixtures("unchecked")
def test_overrides_with_one_value_stay_unchanged(stock):
    found = compose_sweep(["~env.events.push", "run.name='a b'", "seed=1,2", "env.scene.spacing=1e0"])
    assert found.jobs[1].overrides == ("~env.events.push", "run.name='a b'", "seed=2", "env.scene.spacing=1e0")
    assert [job.swept for job in found.jobs] == [("seed=1",), ("seed=2",)]


def test_a_job_is_composed_as_if_it_were_alone(stock):
    found = compose_sweep([*JOBLIB, "task=stand,walk", "env.rewards.height.weight=-1.0,-2.0"])
    for job in found.jobs:
        alone = compose(job.overrides)
        assert (job.config, job.digest) == (alone.config, digest_of(alone))
    assert len({job.digest for job in found.jobs}) == 4


@pytest.mark.usefixtures("unchecked")
def test_settings_of_the_launcher_are_not_the_jobs(stock):
    found = compose_sweep(["seed=1,2", *JOBLIB])
    assert (found.launcher, found.n_jobs) == ("joblib", 2)
    assert [job.overrides for job in found.jobs] == [("seed=1",), ("seed=2",)]
    alone = compose_sweep(["seed=1,2"])
    assert (alone.launcher, alone.n_jobs) == ("basic", 1)


def test_every_job_searches_the_users_folders(stock, user):
    path = f"hydra.searchpath=['file://{user}']"
    found = compose_sweep([path, "task=hop,stand"])
    assert [job.overrides for job in found.jobs] == [(path, "task=hop"), (path, "task=stand")]
    found = compose_sweep(["task=glob(*)"], config_dirs=[user])
    assert [job.config["task"]["name"] for job in found.jobs] == ["hop", "stand", "walk"]


@pytest.mark.usefixtures("unchecked")
def test_progress_counts_the_checked_jobs(stock):
    seen = []
    compose_sweep(["seed=1,2,3"], progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


_APP = """
import hydra, json
from hydra.core.hydra_config import HydraConfig

@hydra.main(version_base="1.3", config_path=None)
def main(config):
    print(json.dumps(list(HydraConfig.get().overrides.task)))

main()
"""


def test_the_whole_sweep_is_what_a_hydra_program_makes_of_the_same_words(stock, tmp_path):
    texts = ["task=walk", "seed=range(1,3)", "env.rewards.height.weight=-1.0,-2.0", "~env.events.push", *JOBLIB[:1]]
    app = tmp_path / "app.py"
    app.write_text(_APP)
    words = ["-m", "--config-dir", stock, "--config-name", "train", *texts, "hydra.launcher.n_jobs=1"]
    command = [sys.executable, app, *words, "hydra.sweep.dir=theirs"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    ours = compose_sweep([*texts, "hydra.launcher.n_jobs=1"])
    jobs = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(jobs) == 4
    assert [_meaning(job.overrides) for job in ours.jobs] == list(map(_meaning, jobs))
    theirs = yaml.safe_load((tmp_path / "theirs" / "multirun.yaml").read_text())
    mine = yaml.safe_load(OmegaConf.to_yaml(ours.multirun))
    for config in (theirs, mine):  # Remove the settings that name the program and the folder.
        hydra = config["hydra"]
        del hydra["runtime"]["config_sources"], hydra["job"]["name"], hydra["sweep"]
        hydra["overrides"]["hydra"] = [text for text in hydra["overrides"]["hydra"] if "hydra.sweep.dir" not in text]
    assert mine == theirs


def test_a_key_that_only_the_swept_tasks_have_is_accepted(stock):
    found = compose_sweep(["task=walk", "env.rewards.smooth.weight=-1.0,-2.0", "seed=3"])
    assert len(found.jobs) == 2
    found = compose_sweep(["task=walk,walk", "env.rewards.smooth.weight=-1.0", *JOBLIB])
    assert [job.config["env"]["rewards"]["smooth"]["weight"] for job in found.jobs] == [-1.0, -1.0]
    assert found.n_jobs == 2
    assert found.multirun.hydra.overrides.task == ["task=walk,walk", "env.rewards.smooth.weight=-1.0"]


def _mistakes(*texts: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        compose_sweep(texts)
    return [str(error) for error in parts(caught.value)]


def test_mistakes_of_all_jobs_are_reported_once_each(stock):
    told = _mistakes("seed=1,a,b", "env.decimation=0", "env.num_envs=1,2")
    seed = f"expected a whole number, at least 0, at most {2**63 - 1}"
    assert sorted(told) == [
        "env.decimation: 0 is out of range (override env.decimation=0); expected a whole number, at least 1, "
        "at most 10000",
        f"seed: 'a' is not of the right type (override seed=a); {seed}",
        f"seed: 'b' is not of the right type (override seed=b); {seed}",
    ]


def test_a_mistake_of_some_jobs_names_their_values(stock):
    (one,) = _mistakes("task=walk,stand", "seed=1,2", "env.rewards.smooth.weight=-1.0")
    assert one.startswith("env.rewards.smooth")
    assert "[with task=stand seed=1 and 1 more]" in one


def test_a_mistake_in_a_file_of_all_jobs_is_reported_without_a_job(stock, edit):
    edit("task/stand.yaml", "decimation: 2", "decimation: 0")
    (told,) = _mistakes("seed=1,2,3")
    assert "configs/task/stand.yaml:19" in told
    assert "with seed" not in told


def test_mistakes_of_every_kind_are_reported_together(stock):
    told = _mistakes("seed=interval(0,1)", "hydra.sweep.dir=x", "env.decimation=0", "oh", "run.name=a,b", "agent.x=1")
    assert [text.split(":")[0] for text in told] == ["oh", "seed", "hydra.sweep.dir", "agent.x", "env.decimation"]


@pytest.mark.parametrize(
    ("words", "parts_of_the_message"),
    [
        (["hydra.sweep.dir=x"], ["hydra.sweep.dir: nothing reads this", "override hydra.sweep.dir=x", "run.root"]),
        (["hydra/sweeper=optuna"], ["hydra/sweeper: 'optuna' is not supported", "expected one of basic"]),
        (["hydra/launcher=joblb"], ["hydra/launcher: 'joblb'", "one of basic, joblib", "did you mean 'joblib'"]),
        (["hydra/launcher=basic,joblib"], ["hydra/launcher: Hydra's own settings cannot be swept"]),
        (["hydra.launcher.n_jobs=2"], ["n_jobs: the basic launcher", "hydra/launcher=joblib in addition"]),
        ([*JOBLIB[:1], "hydra.launcher.n_jobs=0"], ["hydra.launcher.n_jobs: no job would ever run"]),
        ([*JOBLIB[:1], "hydra.launcher.n_job=2"], ["hydra.launcher.n_job: nothing reads this", "n_jobs, how many"]),
        (["seed=interval(0,1)"], ["seed: an interval has no single values", "choice(0.1,0.5)"]),
        (["task=glob(x*)"], ["task: this override has no value", "matches one of stand, walk"]),
        (["seed=1,2", "seed=3"], ["seed: this key is given several times", "override seed=1,2"]),
        (["task=stand", "task=walk"], ["task: this key is given several times"]),
        (["seed=[1"], ["seed=[1: not an override"]),
    ],
    ids=lambda words: " ".join(words) if all("=" in w for w in words) else "",
)
@pytest.mark.usefixtures("unchecked")
def test_an_unsupported_sweep_is_rejected_with_the_right_syntax(stock, words, parts_of_the_message):
    told = _mistakes(*words)
    assert [part for part in parts_of_the_message if part not in told[0]] == []


@pytest.mark.usefixtures("unchecked")
def test_a_launcher_that_a_file_chooses_is_checked_too(stock, edit, monkeypatch):
    edit("train.yaml", "- _self_", "- override hydra/launcher: joblib\n  - _self_")
    assert compose_sweep(["seed=1,2"]).launcher == "joblib"
    monkeypatch.setattr(sweep, "LAUNCHERS", ("basic",))
    assert _mistakes("seed=1,2") == ["hydra/launcher: 'joblib' is not supported; expected one of basic"]


@pytest.mark.parametrize(
    "words",
    [["seed=range(0,100000)"], ["seed=range(0,100000000000)"], ["seed=range(0,100)", "agent.gamma=range(0,1,0.05)"]],
)
def test_a_sweep_of_too_many_jobs_is_refused(words):
    with pytest.raises(ConfigError, match="the sweep has more than 1,000 jobs"):
        compose_sweep(words)


@pytest.mark.parametrize(("words", "option"), [("realism=[full,sensors]", "none"), ("task=[stand,walk]", "velocity")])
def test_a_group_of_one_option_refuses_a_list(words, option):
    with pytest.raises(ConfigError, match=f"takes one option.*one of .*{option}"):
        compose([words])
