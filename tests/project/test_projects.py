from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import pytest
from jobs.small import TINY, refused, succeed, wheelleg

from wheelleg_exp import packages as projects
from wheelleg_exp.cli.completion import answer
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.gym.task_env import task_env
from wheelleg_exp.terms import term_binding

DECLARED = '[project.entry-points."wheelleg_exp.packages"]\n'


def project(folder: Path, package: str = "shelf", declares: str | None = None) -> Path:
    files = {
        "pyproject.toml": DECLARED + (f'x = "{package}"\n' if declares is None else declares),
        f"{package}/__init__.py": "",
        f"{package}/terms.py": f"""
            from pathlib import Path
            Path({str(folder / "ran")!r}).touch()
            def calm(env):
                \"\"\"One.\"\"\"
                return 1.0
        """,
        "stray.py": "raise RuntimeError('a module that nobody declared')",
        f"configs/reward/{package}_calm.yaml": f"""
            # Being calm.
            {package}_calm:
              _target_: {package}.terms.calm
              weight: 1.0
        """,
        f"configs/task/{package}_task.yaml": f"""
            # @package _global_
            # Stand calmly.
            defaults:
              - stand
              - /reward@env.rewards: [{package}_calm]
              - _self_
            task: {{name: {package}_task}}
        """,
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(textwrap.dedent(text).lstrip("\n"))
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Create a project in the folder ``p``, and enter the folder."""
    root = project(tmp_path / "p")
    monkeypatch.chdir(root)
    return root


def test_the_configs_of_the_current_project_are_found(tmp_path, monkeypatch):
    root = project(tmp_path / "p")
    assert wheelleg("compose", "task=shelf_task").status == 2
    for folder in (root, root / "configs" / "task"):
        monkeypatch.chdir(folder)
        assert "shelf.terms.calm" in succeed("compose", "task=shelf_task", "--package", "env.rewards").out


def test_the_nearest_project_counts(tmp_path, monkeypatch):
    project(tmp_path)
    inner = project(tmp_path / "inner", "drawer")
    monkeypatch.chdir(inner)
    assert projects.current_project().packages == ("drawer",)


def test_a_pyproject_without_the_declaration_is_not_a_project(tmp_path, monkeypatch):
    root = project(tmp_path / "p", declares="")
    monkeypatch.chdir(root)
    assert projects.current_project() is None
    assert wheelleg("compose", "task=shelf_task").status == 2


@pytest.mark.parametrize("given", ["p", "p/configs"], ids=["its folder", "its configs"])
def test_config_dir_names_a_project_from_elsewhere(given, tmp_path):
    project(tmp_path / "p")
    succeed("check", "--config-dir", given, "task=shelf_task")
    assert (tmp_path / "p" / "ran").exists()


def test_config_dir_may_name_an_installed_package(tmp_path, monkeypatch):
    site = tmp_path / "site"
    root = project(site)
    (root / "pyproject.toml").unlink()
    (root / "configs").rename(root / "shelf" / "configs")
    info = site / "shelf-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: shelf\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[wheelleg_exp.packages]\nshelf = shelf\n")
    assert wheelleg("compose", "--config-dir", "shelf", "task=shelf_task").status == 2
    monkeypatch.syspath_prepend(str(site))
    term_binding._declared_packages.cache_clear()
    said = wheelleg("check", "--config-dir", "shelf", "task=shelf_task")
    term_binding._declared_packages.cache_clear()
    for name in [name for name in sys.modules if name.split(".")[0] == "shelf"]:
        del sys.modules[name]
    assert said.status == 0, said.err


def test_the_code_of_a_project_runs_only_for_a_check_of_its_terms(here):
    for words in ("compose task=shelf_task --provenance", "list tasks", "list options reward", "check task=stand"):
        succeed(*words.split())
        assert not (here / "ran").exists(), words
    assert answer("wheelleg train task=sh") == ["task=shelf_task"]
    assert "env.rewards.shelf_calm." in answer("wheelleg train task=shelf_task env.rewards.shelf_c")
    assert not (here / "ran").exists()
    succeed("check", "task=shelf_task")
    assert (here / "ran").exists()


def test_only_the_declared_package_of_the_folder_can_be_imported(here):
    term = "+env.rewards.x={_target_: stray.f, weight: 1.0}"
    assert "outside the allowed packages" in refused("check", "task=stand", term)
    succeed("check", "task=shelf_task")
    with pytest.raises(ModuleNotFoundError):
        __import__("stray")


def test_a_package_that_is_not_declared_is_not_called(tmp_path, monkeypatch):
    root = project(tmp_path / "p", declares='x = "other"\n')
    (root / "other").mkdir()
    monkeypatch.chdir(root)
    message = refused("check", "task=shelf_task")
    assert "'shelf.terms.calm' is outside the allowed packages" in message
    assert "configs/reward/shelf_calm.yaml:3" in message
    assert not (root / "ran").exists()


def test_the_current_project_has_priority_over_an_installed_package_of_its_name(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(project(tmp_path / "installed")))
    monkeypatch.chdir(project(tmp_path / "here"))
    assert wheelleg("check", "task=shelf_task").status == 0
    assert (tmp_path / "here" / "ran").exists()
    assert not (tmp_path / "installed" / "ran").exists()


def test_a_package_that_was_imported_from_elsewhere_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(project(tmp_path / "installed")))
    __import__("shelf")
    monkeypatch.chdir(project(tmp_path / "here"))
    said = wheelleg("check", "task=shelf_task")
    del sys.modules["shelf"]
    assert said.status == 2
    assert "already been imported from elsewhere" in said.err


@pytest.mark.train
def test_a_network_of_a_project_that_is_not_installed_trains(here):
    (here / "shelf" / "nets.py").write_text("from rsl_rl.models import MLPModel\n\n\nclass Mine(MLPModel):\n    pass\n")
    words = [*TINY, "agent.max_iterations=1", "recording.enabled=false", "agent.actor.class_name=shelf.nets:Mine"]
    succeed("train", "task=stand", *words)


def test_a_project_of_another_user_is_used_only_if_the_command_names_it(here, monkeypatch):
    monkeypatch.setattr(projects.os, "getuid", lambda: 4242)
    monkeypatch.setattr(projects, "_ROOT", 4343)
    message = refused("check", "task=stand")
    assert "a project of another user" in message
    assert f"--config-dir {here / 'configs'}" in message
    assert not (here / "ran").exists()
    succeed("check", "--config-dir", ".", "task=shelf_task")


@pytest.mark.parametrize("value", ['"os"', '"wheelleg_exp"', '"not a name"', "3"])
def test_a_declaration_of_something_else_than_a_package_of_the_project_is_refused(value, tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p", declares=f"x = {value}\n"))
    assert str(tmp_path / "p" / "pyproject.toml") in refused("check", "task=stand")


def test_a_declared_package_that_does_not_exist_is_reported_when_it_is_used(tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p", declares='x = "shelf"\ny = "absent"\n'))
    succeed("check", "task=shelf_task")
    message = refused("check", "task=stand", "+env.rewards.x={_target_: absent.f, weight: 1.0}")
    assert "the project has no package 'absent'" in message


def test_a_package_in_src_is_found(here):
    (here / "src").mkdir()
    (here / "shelf").rename(here / "src" / "shelf")
    succeed("check", "task=shelf_task")


def test_an_invalid_pyproject_is_reported_only_if_it_declares_a_package(tmp_path):
    (tmp_path / "pyproject.toml").write_text("[broken\n")
    succeed("compose")
    (tmp_path / "pyproject.toml").write_text(DECLARED + "[broken\n")
    message = refused("compose")
    assert "the file is not valid TOML" in message
    assert str(tmp_path / "pyproject.toml") in message


def test_gymnasium_finds_the_current_project(tmp_path, monkeypatch):
    root = project(tmp_path / "p")
    text = (root / "shelf" / "terms.py").read_text()
    (root / "shelf" / "terms.py").write_text(text.replace("return 1.0", "return env.episode_length_buf * 0.0 + 1.0"))
    with pytest.raises(ConfigError, match="shelf_task"):
        task_env("shelf_task", 1, [], [])
    monkeypatch.chdir(root)
    assert "shelf_calm" in task_env("shelf_task", 1, ["env.sim.nthread=1"], []).reward_manager.active_terms
