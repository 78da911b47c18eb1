from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from asset.corpus import ABSENT, corpus_folder
from jobs.small import TINY, cache_of, succeed, wheelleg
from patience import PATIENCE_S
from project.conftest import _no_project_stays as _no_project_stays
from project.robots import urdf
from refused import refusal

from wheelleg_exp import packages as projects
from wheelleg_exp.project import create
from wheelleg_exp.terms.key_syntax import names_pipeline

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_folders")]

ROOT = Path(__file__).resolve().parents[2]
LONG = ("stock", "wf_tron2a_isaac/robot.usd")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def robot_of(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    if name == "stock":
        return []
    if name == "urdf":
        return ["--robot", str(urdf(tmp_path / "robots"))]
    folder = corpus_folder(request.config.getoption("--corpus"))
    if folder is None:
        pytest.skip(ABSENT)
    return ["--robot", str(folder / "assets" / name)]


@pytest.mark.usefixtures("made")
def test_the_tests_of_a_new_project_pass():
    tests = run("pytest", "-q", "-p", "no:cacheprovider")
    assert tests.returncode == 0, tests.stdout
    assert "4 passed" in tests.stdout


@pytest.mark.train
@pytest.mark.parametrize("robot", ["urdf", *(pytest.param(name, marks=pytest.mark.full) for name in LONG)])
def test_a_new_project_checks_and_trains(robot, request, tmp_path, monkeypatch):
    succeed("new", "myrobot", *robot_of(robot, request, tmp_path))
    monkeypatch.chdir(tmp_path / "myrobot")
    assert wheelleg("check", "task=myrobot").out == "no mistakes in the task 'myrobot'\n"
    words = [word for word in TINY if "episode_length" not in word]
    trained = succeed("train", "task=myrobot", *words, "agent.max_iterations=1", "recording.enabled=false")
    assert trained.out.startswith("trained 1 iteration")
    (found,) = (tmp_path / "myrobot" / "runs" / "myrobot").iterdir()
    assert (found / "model_0.pt").is_file()
    succeed("play", "latest", "env.num_envs=4")


@pytest.fixture(scope="module")
def created(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        patch.chdir(tmp_path_factory.mktemp("created"))
        return Path.cwd() / "myrobot", succeed("new", "myrobot")


@pytest.fixture
def made(created, own_folders, tmp_path, monkeypatch):
    shutil.copytree(created[0], tmp_path / "myrobot")
    monkeypatch.chdir(tmp_path / "myrobot")
    return tmp_path / "myrobot", created[1]


def test_it_reports_what_was_made_and_its_commands_compose(made):
    root, said = made
    assert not [name for name in sys.modules if name.split(".")[0] == "myrobot"]  # The draft leaves nothing imported.
    assert not [project for project in projects._joined.values() if ".tmp" in str(project.root)]
    names = {path.relative_to(root / "configs") for path in (root / "configs").rglob("*.yaml")}
    assert not [name for name in names if (ROOT / "configs" / name).exists()]  # No file hides a stock file.
    assert said.out.startswith(f"created myrobot: {len([p for p in root.rglob('*') if p.is_file()])} files\n")
    assert "legs: l01, r01, l02, r02" in said.out
    assert "wheels: l03, r03" in said.out
    commands = [line.removeprefix("next:").strip() for line in said.out.splitlines() if "wheelleg " in line]
    of_readme = [line for line in (root / "README.md").read_text().splitlines() if line.startswith("wheelleg ")]
    assert len(of_readme) >= 5
    lines = [command.split("#")[0].split()[2:] for command in (*commands, *of_readme)]
    for words in {tuple(word for word in line if "=" in word and "protocol" not in word) for line in lines}:
        succeed("check" if any(map(names_pipeline, words)) else "compose", *words)


def test_its_config_is_its_own(made, monkeypatch):
    tasks = [wheelleg("compose", "--resolve", f"task={task}") for task in ("myrobot", "stand")]
    composed, stock = (yaml.safe_load(said.out)["env"] for said in tasks)
    assert (composed["robot"]["asset"], composed["robot"]["profile"]) == ("myrobot/wheelleg.usda", "myrobot")
    assert composed["rewards"]["myrobot_upright"]["_target_"] == "myrobot.terms.upright"
    assert composed["actions"]["wheel_vel"]["joint_names"] == ["l03", "r03"]
    assert stock["robot"]["asset"] == "wheelleg/wheelleg.usda"
    root, _ = made
    (root / "assets" / "myrobot" / "wheelleg.usda").unlink()
    assert str(root / "assets") in refusal("check", "task=myrobot")


def test_the_physics_check_finds_only_defects_of_the_robot(made):
    _, told = made
    said = wheelleg("check", "--physics", "--json", "task=myrobot")
    document = json.loads(said.out)
    assert (said.status, document["findings"]) == (0, [])
    accepted = {finding["rule"] for finding in document["silenced"] if finding["key"].split(".")[1] == "robot"}
    assert {word for word in accepted if f"({word})" in told.out} == accepted != set()


def test_it_passes_the_linters_of_this_repository(made):
    root, _ = made
    for words in (["check"], ["format", "--check"]):
        settings = ("--config", str(ROOT / "pyproject.toml"), "--config", "lint.isort.known-first-party=['myrobot']")
        done = run("ruff", *words, *settings, "--no-cache", str(root))
        assert done.returncode == 0, done.stdout


def test_a_command_of_the_shell_works_in_it(made):
    said = run("wheelleg_exp.cli.main", "explain", "env.rewards.myrobot_upright.std", "task=myrobot")
    assert said.returncode == 0, said.stderr
    assert "tilt that leaves 1/e of the reward" in said.stdout
    assert "configs/reward/myrobot_upright.yaml" in said.stdout


def test_a_folder_may_be_named_with_its_place(tmp_path):
    (tmp_path / "robots").mkdir()
    assert "cd robots/myrobot" in succeed("new", "robots/myrobot").out
    assert wheelleg("check", "--config-dir", "robots/myrobot", "task=myrobot").status == 0


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_an_existing_place_is_not_overwritten(kind, tmp_path):
    place = tmp_path / "myrobot"
    {"folder": place.mkdir, "file": place.touch, "link": lambda: place.symlink_to("nowhere")}[kind]()
    assert "exists already" in refusal("new", "myrobot")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["myrobot"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["my-robot"], "did you mean 'my_robot'?"),
        (["test"], "did you mean 'test_robot'?"),
        (["nowhere/myrobot"], "the parent folder of the new project does not exist"),
        (["myrobot", "--robot", "two.urd"], "did you mean 'two.urdf'?"),
        (["myrobot", "--robot", "broken.urdf"], "broken.urdf"),
        (["myrobot", "--robot", "robots"], "is a folder"),
        ([], "NAME: the argument is missing"),
    ],
)
def test_a_mistake_is_reported_and_leaves_nothing(words, said, tmp_path):
    urdf(tmp_path)
    (tmp_path / "robots").mkdir()
    (tmp_path / "broken.urdf").write_text("<robot")
    before = sorted(path.name for path in tmp_path.iterdir())
    message = refusal("new", *words)
    assert said in message
    assert ".tmp" not in message
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("patched", "error", "status", "message"),
    [
        ("find_mistakes", KeyboardInterrupt(), 130, ""),
        ("write", OSError(28, "No space left on device"), 3, "no space left on device"),
    ],
)
def test_a_failure_or_interrupt_leaves_nothing(tmp_path, monkeypatch, patched, error, status, message):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(create, patched, fail)
    said = wheelleg("new", "myrobot")
    assert said.status == status
    assert message in said.err
    assert not list(tmp_path.iterdir())


def test_no_project_is_created_inside_the_program_itself(monkeypatch):
    monkeypatch.chdir(ROOT / "docs")
    assert "inside the package wheelleg_exp itself" in refusal("new", "myrobot")
    assert not (ROOT / "docs" / "myrobot").exists()
