"""The examples in ``docs/examples``: folders of YAML that work as they stand, with robots from elsewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import torch
from asset.corpus import ABSENT, VARIABLE, corpus_folder
from jobs.small import TINY, cache_of, wheelleg

from wheelleg_exp.build import build_env
from wheelleg_exp.config.checking.find_mistakes import check
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = sorted(path for path in (ROOT / "docs" / "examples").iterdir() if (path / "task").is_dir())
TASKS = [(folder, path.stem) for folder in FOLDERS for path in sorted((folder / "task").glob("*.yaml"))]
# The primary commands of a README's bash blocks; what follows ` #` is a comment.
COMMAND = re.compile(r"^wheelleg (?:compose|train|zero-agent) (.*)$", re.MULTILINE)

every_task = pytest.mark.parametrize(("folder", "task"), TASKS, ids=[task for _, task in TASKS])
every_folder = pytest.mark.parametrize("folder", FOLDERS, ids=[folder.name for folder in FOLDERS])


@pytest.fixture(autouse=True)
def _own_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))


@pytest.fixture
def _robots(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    corpus = corpus_folder(request.config.getoption("--corpus"))
    if corpus is None:
        pytest.skip(ABSENT)
    monkeypatch.setenv(VARIABLE, str(corpus))


def small_env(folder: Path, task: str) -> ManagerBasedRLEnv:
    """Build four environments of a task."""
    composed = compose([f"task={task}", "env.num_envs=4", "env.sim.nthread=1"], config_dirs=[folder])
    return build_env(composed.config, composed.asset_roots)


def roll(env: ManagerBasedRLEnv, actor) -> list[torch.Tensor]:
    """Step 20 times and return who failed, after looking at every number that an agent would get."""
    env.reset(seed=0)
    failed = []
    for _ in range(20):
        observations, rewards, terminated, _, _ = env.step(actor())
        assert all(group.isfinite().all() for group in observations.values())
        assert rewards.isfinite().all()
        assert env.scene.robot.data.joint_pos.isfinite().all()
        failed.append(terminated.clone())
    return failed


# --- without the robot's file ---


@every_folder
def test_an_example_is_yaml_and_its_description_alone(folder):
    files = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".yaml", ".md"}
    assert Path("README.md") in files
    assert list((folder / "task").glob("*.yaml"))


@every_task
def test_nothing_but_the_robots_file_is_missing(folder, task, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    mistakes = check(compose([f"task={task}"], config_dirs=[folder]))
    assert [str(error) for error in mistakes if error.key != "env.robot.asset"] == []


@every_folder
def test_the_commands_of_an_examples_readme_compose(folder, monkeypatch):
    monkeypatch.chdir(ROOT)
    commands = [shlex.split(words, comments=True) for words in COMMAND.findall((folder / "README.md").read_text())]
    assert commands
    for words in commands:
        said = wheelleg("compose", *words)
        assert said.status == 0, said.err


# --- with it ---


@every_task
@pytest.mark.usefixtures("_robots")
def test_an_example_has_no_mistakes(folder, task):
    assert [str(error) for error in check(compose([f"task={task}"], config_dirs=[folder]))] == []


@every_task
@pytest.mark.usefixtures("_robots")
def test_an_examples_robot_holds_its_pose_for_a_while_without_a_policy(folder, task):
    """Zero actions for 20 control steps: it neither falls nor starts inside the ground, which would throw it up."""
    env = small_env(folder, task)
    height = env.scene.robot.data.root_pos_w[:, 2].clone()
    failed = roll(env, lambda: torch.zeros(4, env.action_manager.total_action_dim))
    assert not torch.stack(failed).any()
    moved = (env.scene.robot.data.root_pos_w[:, 2] - height).abs()
    assert (moved < 0.05 * height).all(), moved


@every_task
@pytest.mark.usefixtures("_robots")
def test_an_example_stays_finite_under_wild_actions(folder, task):
    env = small_env(folder, task)
    generator = torch.Generator().manual_seed(0)
    shape = (4, env.action_manager.total_action_dim)
    failed = roll(env, lambda: 6.0 * torch.rand(shape, generator=generator) - 3.0)
    assert len(failed) == 20
    assert not env.scene.sim.unstable().any()


@every_task
@pytest.mark.train
@pytest.mark.usefixtures("_robots")
def test_an_example_trains(folder, task, tmp_path):
    words = [*TINY, "agent.max_iterations=2", "recording.enabled=false", f"run.root={tmp_path}"]
    said = wheelleg("train", "--config-dir", folder, f"task={task}", *words)
    assert said.status == 0, said.err
    (path,) = (tmp_path / task).iterdir()
    run = RunDirectory.open(path, tmp_path)
    assert run.latest_checkpoint().name == "model_1.pt"
    assert not run.manifest().compare_files()
