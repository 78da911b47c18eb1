from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from jobs.small import cache_of

from wheelleg_exp import packages as projects


@pytest.fixture(autouse=True)
def _own_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))


@pytest.fixture(autouse=True)
def _no_project_stays() -> Iterator[None]:
    yield
    for project in list(projects._joined.values()):
        projects.forget(project.root)
