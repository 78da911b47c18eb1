import itertools
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from jobs.small import wheelleg

from foreign.trial import Trial, every_second, plant_project
from wheelleg_exp import packages as projects
from wheelleg_exp.packages import trust

pytestmark = pytest.mark.train

DECLARED = '[project.entry-points."wheelleg_exp.packages"]\nx = "evil"\n'


def project(folder: Path, canary: Path) -> Path:
    return plant_project(folder, f"open({str(canary)!r}, 'w').close()\n")


@pytest.fixture(autouse=True)
def _forgotten() -> Iterator[None]:
    before = dict(projects._joined)
    yield
    projects._joined.clear()
    projects._joined.update(before)


@pytest.fixture
def asking(trial: Trial) -> Trial:
    change = {"_target_": "evil.terms.f", "weight": 1.0}
    trial.yaml("params/env.yaml", lambda env: env["rewards"].update(evil=change))
    return trial


NAMES = {
    "absolute": lambda trial: str(trial.run.path / "configs"),
    "relative": lambda trial: os.path.relpath(trial.run.path / "configs"),
    "of the process": lambda _: "/proc/self/cwd/../runs/configs",
    "around": lambda trial: f"{trial.run.path}/../{trial.run.path.name}/configs",
}


@pytest.mark.parametrize(("name", "command"), every_second(NAMES.values(), ["resume", "play", "report"]))
def test_a_project_in_the_run_is_not_used(asking, name, command):
    project(asking.run.path, asking.canary)
    word = name(asking)
    asking.manifest(config_dirs=[word])
    told = () if command == "report" else ("target 'evil.terms.f' is outside the allowed packages",)
    asking.try_(command, 2 if told else 0, *told)


def test_the_error_names_the_untrusted_folder_and_the_option(asking):
    configs = project(asking.root / "theirs", asking.canary)
    asking.manifest(config_dirs=[str(configs)])
    told = f"what the run was made with is not one of your trusted folders: {configs}"
    asking.try_("resume", 2, told, "--config-dir with the place where that folder is now, if it is yours")


def test_a_project_beside_the_run_that_its_command_line_names_is_not_used(asking):
    configs = project(asking.root / "theirs", asking.canary)
    command = ["wheelleg", "train", "--config-dir", str(configs), f"--config-dir={configs.parent}"]
    asking.manifest(config_dirs=None, command=command, working_directory=str(asking.root))
    asking.try_("resume", 2, "is not one of your trusted folders")


@pytest.mark.parametrize("folder", ["gone", "\0", "x" * 5000, "", "/dev/null", "\n"])
def test_an_invalid_config_folder_is_refused(asking, folder):
    asking.manifest(config_dirs=[folder])
    asking.try_("resume", 2, "evil.terms.f")


def test_a_link_into_the_run_is_as_the_run(asking):
    configs = project(asking.run.path, asking.canary)
    link = asking.root / "mine"
    link.symlink_to(asking.root / "elsewhere")
    (asking.root / "elsewhere").mkdir()
    trust([link])
    link.unlink()
    link.symlink_to(configs)
    asking.manifest(config_dirs=[str(link)])
    asking.try_("resume", 2, "is not one of your trusted folders")


def test_the_users_own_project_is_found_again_and_may_be_named(asking):
    configs = project(asking.root / "own", asking.canary)
    asking.manifest(config_dirs=[str(configs)])
    trust([configs])
    said = wheelleg(*asking.words("resume"))
    assert "outside the allowed packages" not in said.err
    assert asking.canary.exists()


@pytest.mark.parametrize("command", ["play", "report", "resume", "inspect", "diff", "verify"])
def test_a_command_in_a_run_does_not_use_the_runs_project(asking, command, monkeypatch):
    project(asking.run.path, asking.canary)
    for folder in (asking.run.path / "params", asking.run.path):
        monkeypatch.chdir(folder)
        asking.try_(command, (0, 1, 2))


PYPROJECTS = {
    "deep": DECLARED + "a = " + "[" * 100_000,
    "a long number": DECLARED + "a = " + "1" * 5000,
    "a package of others": DECLARED.replace("evil", "../../evil"),
    "a module of Python": DECLARED.replace("evil", "os"),
}


@pytest.mark.parametrize("text", PYPROJECTS.values(), ids=PYPROJECTS)
def test_a_declaration_may_be_anything(trial, text, monkeypatch):
    folder = trial.root / "theirs"
    folder.mkdir()
    (folder / "pyproject.toml").write_text(text)
    monkeypatch.chdir(folder)
    trial.try_("list", 2, "pyproject.toml")
    trial.try_("play", 0)


def test_a_declaration_that_is_a_pipe_is_not_read(trial, monkeypatch):
    folder = trial.root / "theirs" / "configs"
    folder.mkdir(parents=True)
    os.mkfifo(folder.parent / "pyproject.toml")
    monkeypatch.chdir(folder)
    trial.try_("list", 0)
    assert wheelleg("list", "tasks", "--config-dir", ".").status == 0


def bomb() -> str:
    lines = [f"{c}: &{c} [{', '.join([f'*{p}'] * 9)}]\n" for p, c in itertools.pairwise("abcdefghi")]
    return "a: &a [x, x]\n" + "".join(lines)


FILES = {
    "a pipe": os.mkfifo,
    "deep": lambda path: path.write_text("a: " + "[" * 100_000),
    "deep mappings": lambda path: path.write_text("".join(" " * i + "a:\n" for i in range(3000))),
    "a bomb": lambda path: path.write_text(bomb()),
    "a tag": lambda path: path.write_text("a: !!python/object/apply:os.system ['touch ../ran']\n"),
    "no text": lambda path: path.write_bytes(b"\xff\xfe"),
}
COMMANDS = [("list", "tasks"), ("compose", "task=evil"), ("check", "task=evil"), ("explain", "a", "task=evil")]


@pytest.mark.parametrize(("name", "words"), every_second(FILES, COMMANDS))
def test_a_config_of_a_project_may_be_anything(trial, name, words):
    configs = project(trial.root / "theirs", trial.canary)
    (configs / "task").mkdir()
    FILES[name](configs / "task" / "evil.yaml")
    said = wheelleg(*words, "--config-dir", configs)
    assert said.status in (0, 2), said.err
    assert "--debug" not in said.err, said.err
    assert not trial.canary.exists()
