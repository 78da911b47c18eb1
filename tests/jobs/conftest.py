"""One training for all tests, and copies of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from forks import forking

from jobs.small import Trained, copied, shared_cache
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.stop_request import StopRequest


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True, scope="module")
def _cache_and_threads(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Set the cache folder before the fixtures of a module, and restore the number of threads after its tests."""
    with shared_cache(tmp_path_factory):
        yield


@pytest.fixture(scope="module")
def forks() -> Iterator[None]:
    with forking():
        yield


@pytest.fixture
def run(trained: Trained, tmp_path: Path) -> RunDirectory:
    return copied(trained, tmp_path)


@pytest.fixture
def stop() -> Iterator[StopRequest]:
    with StopRequest() as request:
        yield request
