"""Test which folders the source snapshot of a run contains."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from project.test_projects import project

from wheelleg_exp import packages as projects
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.jobs.train.source_roots import loaded_outside, source_roots
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_snapshot import snapshot_source

STOCK = configs_dir().parent


def write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def mine(tmp_path):
    root = project(tmp_path / "mine", "shelf_of_roots")
    yield root
    projects.forget(root)


def test_the_stock_task_depends_on_this_package_alone():
    assert source_roots(compose(["task=stand"])) == [STOCK]


def test_a_project_counts_as_a_whole(mine):
    assert source_roots(compose(["task=shelf_of_roots_task"], config_dirs=[mine / "configs"])) == [STOCK, mine]


def test_a_plain_config_folder_and_one_of_the_search_path_count(tmp_path):
    for name in ("a", "b"):
        write(tmp_path / name / "reward" / f"{name}.yaml", f"{name}: {{_target_: x.y, weight: 1.0}}\n")
    words = ["+reward@env.rewards=a", f"hydra.searchpath=[file://{tmp_path / 'b'}]"]
    assert source_roots(compose(words, config_dirs=[tmp_path / "a"])) == [STOCK, tmp_path / "a", tmp_path / "b"]


def test_an_installed_package_that_configs_call_counts(tmp_path, monkeypatch):
    package = write(tmp_path / "site-packages" / "of_roots" / "__init__.py", "").parent
    info = package.parent / "of_roots-1.0.dist-info"
    write(info / "METADATA", "Metadata-Version: 2.1\nName: of_roots\nVersion: 1.0\n")
    write(info / "entry_points.txt", "[wheelleg_exp.packages]\nx = of_roots\n")
    monkeypatch.syspath_prepend(str(package.parent))
    plain = compose(["task=stand"])
    called = compose(["task=stand", "+env.rewards.odd={_target_: of_roots.calm, weight: 1.0}"])
    assert (source_roots(plain), source_roots(called)) == ([STOCK], [STOCK, package])


def test_what_is_imported_from_elsewhere_is_found(tmp_path, monkeypatch):
    write(tmp_path / "helper_of_roots.py", "")
    write(tmp_path / "package_of_roots" / "inner.py", "")
    write(tmp_path / "package_of_roots" / "__init__.py", "")
    monkeypatch.syspath_prepend(str(tmp_path))
    before = loaded_outside([STOCK])
    for name in ["helper_of_roots", "package_of_roots.inner"]:
        importlib.import_module(name)
    found = loaded_outside([STOCK])
    for name in [n for n in sys.modules if n.endswith("_of_roots") or "_of_roots." in n]:
        monkeypatch.delitem(sys.modules, name)
    assert set(found) - set(before) == {tmp_path / "helper_of_roots.py", tmp_path / "package_of_roots"}
    assert not [path for path in found if "site-packages" in path.parts or path.is_relative_to(sys.prefix)]
    assert loaded_outside([STOCK, tmp_path]) == before


def test_a_resume_names_the_files_that_differ_and_knows_its_own_log(mine, tmp_path):
    subprocess.run(["git", "init", "-q", mine], check=True)
    (mine / ".gitignore").write_text("*.log\n")
    run = RunDirectory.create(tmp_path / "runs", "stand", 0)
    Manifest.begin(run.path, task="stand", seed=0, command=[], threads={})
    snapshot_source([STOCK, mine], run.source)
    (mine / "train.log").write_text("step 1\n")
    assert circumstances._source_differences(run, [mine / "configs"]) == []
    write(mine / "configs" / "reward" / "later.yaml", "later: {_target_: x.y, weight: 1.0}\n")
    (difference,) = circumstances._source_differences(run, [mine / "configs"])
    assert (difference.section, difference.name) == ("source", "tree (2)")
    assert difference.note == f"{mine}: added configs/reward/later.yaml"
