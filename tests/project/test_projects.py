from __future__ import annotations

import sys
import textwrap
from pathlib import Path

import pytest
from jobs.small import wheelleg

from wheelleg_exp import packages as projects
from wheelleg_exp.errors import ConfigError
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


def test_the_configs_of_the_project_one_stands_in_are_found(tmp_path, monkeypatch):
    root = project(tmp_path / "p")
    assert wheelleg("compose", "task=shelf_task").status == 2
    for folder in (root, root / "configs" / "task"):
        monkeypatch.chdir(folder)
        said = wheelleg("compose", "task=shelf_task", "--package", "env.rewards")
        assert said.status == 0, said.err
        assert "shelf.terms.calm" in said.out


def test_the_nearest_project_counts(tmp_path, monkeypatch):
    project(tmp_path)
    inner = project(tmp_path / "inner", "drawer")
    monkeypatch.chdir(inner)
    found = projects.current_project()
    assert found is not None
    assert found.packages == ("drawer",)


def test_a_pyproject_without_the_declaration_is_no_project(tmp_path, monkeypatch):
    root = project(tmp_path / "p", declares="")
    monkeypatch.chdir(root)
    assert projects.current_project() is None
    assert wheelleg("compose", "task=shelf_task").status == 2


@pytest.mark.parametrize("given", ["p", "p/configs"], ids=["its folder", "its configs"])
def test_config_dir_names_a_project_from_elsewhere(given, tmp_path):
    project(tmp_path / "p")
    said = wheelleg("check", "--config-dir", given, "task=shelf_task")
    assert said.status == 0, said.err
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


@pytest.mark.parametrize(
    "words",
    [
        ("compose", "task=shelf_task"),
        ("compose", "task=shelf_task", "--provenance"),
        ("list", "tasks"),
        ("list", "options", "reward"),
        ("check", "task=stand"),
    ],
    ids=" ".join,
)
def test_what_needs_no_term_of_a_project_runs_none_of_its_code(words, tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p"))
    said = wheelleg(*words)
    assert said.status == 0, said.err
    assert not (tmp_path / "p" / "ran").exists()


def test_a_tab_in_a_project_offers_its_tasks_and_runs_none_of_its_code(tmp_path, monkeypatch):
    from wheelleg_exp.cli.completion import answer

    monkeypatch.chdir(project(tmp_path / "p"))
    assert answer("wheelleg train task=sh") == ["task=shelf_task"]
    assert "env.rewards.shelf_calm." in answer("wheelleg train task=shelf_task env.rewards.shelf_c")
    assert not (tmp_path / "p" / "ran").exists()


def test_checking_a_config_that_names_a_term_runs_its_module(tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p"))
    said = wheelleg("check", "task=shelf_task")
    assert said.status == 0, said.err
    assert (tmp_path / "p" / "ran").exists()


def test_nothing_but_the_declared_package_can_be_found_in_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p"))
    said = wheelleg("check", "task=stand", "+env.rewards.x={_target_: stray.f, weight: 1.0}")
    assert said.status == 2
    assert "outside the allowed packages" in said.err
    assert wheelleg("check", "task=shelf_task").status == 0
    with pytest.raises(ModuleNotFoundError):
        __import__("stray")


def test_a_package_that_is_not_declared_is_not_called(tmp_path, monkeypatch):
    root = project(tmp_path / "p", declares='x = "other"\n')
    (root / "other").mkdir()
    monkeypatch.chdir(root)
    said = wheelleg("check", "task=shelf_task")
    assert said.status == 2
    assert "'shelf.terms.calm' is outside the allowed packages" in said.err
    assert "configs/reward/shelf_calm.yaml:3" in said.err
    assert not (root / "ran").exists()


def test_the_folder_one_stands_in_wins_over_what_is_installed_under_its_name(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(project(tmp_path / "installed")))
    monkeypatch.chdir(project(tmp_path / "here"))
    assert wheelleg("check", "task=shelf_task").status == 0
    assert (tmp_path / "here" / "ran").exists()
    assert not (tmp_path / "installed" / "ran").exists()


def test_code_that_was_imported_from_elsewhere_is_not_taken_for_the_projects(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(project(tmp_path / "installed")))
    __import__("shelf")
    monkeypatch.chdir(project(tmp_path / "here"))
    said = wheelleg("check", "task=shelf_task")
    del sys.modules["shelf"]
    assert said.status == 2
    assert "already been imported from elsewhere" in said.err


@pytest.mark.train
def test_a_network_of_a_project_that_is_not_installed_trains(tmp_path, monkeypatch):
    from jobs.small import TINY

    root = project(tmp_path / "p")
    (root / "shelf" / "nets.py").write_text("from rsl_rl.models import MLPModel\n\n\nclass Mine(MLPModel):\n    pass\n")
    monkeypatch.chdir(root)
    words = [*TINY, "agent.max_iterations=1", "recording.enabled=false", "agent.actor.class_name=shelf.nets:Mine"]
    said = wheelleg("train", "task=stand", *words)
    assert said.status == 0, said.err


def test_a_project_of_another_user_is_not_used_unasked(tmp_path, monkeypatch):
    root = project(tmp_path / "p")
    monkeypatch.chdir(root)
    monkeypatch.setattr(projects.os, "getuid", lambda: 4242)
    monkeypatch.setattr(projects, "_ROOT", 4343)
    said = wheelleg("check", "task=stand")
    assert said.status == 2
    assert "a project of another user" in said.err
    assert f"--config-dir {root / 'configs'}" in said.err
    assert not (root / "ran").exists()
    named = wheelleg("check", "--config-dir", ".", "task=shelf_task")
    assert named.status == 0, named.err


@pytest.mark.parametrize("value", ['"os"', '"wheelleg_exp"', '"not a name"', "3"])
def test_a_declaration_that_is_no_package_of_the_project_is_refused(value, tmp_path, monkeypatch):
    monkeypatch.chdir(project(tmp_path / "p", declares=f"x = {value}\n"))
    said = wheelleg("check", "task=stand")
    assert said.status == 2
    assert str(tmp_path / "p" / "pyproject.toml") in said.err


def test_a_declared_package_that_is_not_there_is_said(tmp_path, monkeypatch):
    root = project(tmp_path / "p", declares='x = "shelf"\ny = "absent"\n')
    monkeypatch.chdir(root)
    assert wheelleg("check", "task=shelf_task").status == 0
    said = wheelleg("check", "task=stand", "+env.rewards.x={_target_: absent.f, weight: 1.0}")
    assert said.status == 2
    assert "the project has no package 'absent'" in said.err


def test_a_package_in_src_is_found(tmp_path, monkeypatch):
    root = project(tmp_path / "p")
    (root / "src").mkdir()
    (root / "shelf").rename(root / "src" / "shelf")
    monkeypatch.chdir(root)
    said = wheelleg("check", "task=shelf_task")
    assert said.status == 0, said.err


def test_a_pyproject_that_is_no_toml_is_said_only_where_it_declares(tmp_path, monkeypatch):
    (tmp_path / "pyproject.toml").write_text("[broken\n")
    assert wheelleg("compose").status == 0
    (tmp_path / "pyproject.toml").write_text(DECLARED + "[broken\n")
    said = wheelleg("compose")
    assert said.status == 2
    assert "the file is not valid TOML" in said.err
    assert str(tmp_path / "pyproject.toml") in said.err


def test_gymnasium_finds_the_project_one_stands_in(tmp_path, monkeypatch):
    from wheelleg_exp.gym.task_env import task_env

    root = project(tmp_path / "p")
    text = (root / "shelf" / "terms.py").read_text()
    (root / "shelf" / "terms.py").write_text(text.replace("return 1.0", "return env.episode_length_buf * 0.0 + 1.0"))
    with pytest.raises(ConfigError, match="shelf_task"):
        task_env("shelf_task", 1, [], [])
    monkeypatch.chdir(root)
    assert "shelf_calm" in task_env("shelf_task", 1, ["env.sim.nthread=1"], []).reward_manager.active_terms
