import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from verify import synthetic
from wheelleg_exp.run.run_directory import RunDirectory


@pytest.fixture(scope="session")
def _built(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    return synthetic.build(tmp_path_factory.mktemp("synthetic") / "runs")


@pytest.fixture
def copy_run(_built: RunDirectory, tmp_path: Path) -> Callable[[str], RunDirectory]:
    def copied(name: str) -> RunDirectory:
        path = tmp_path / "runs" / "stand" / name
        shutil.copytree(_built.path, path)
        return RunDirectory.open(path, tmp_path / "runs")

    return copied
