"""One training for all tests, and copies of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from jobs.small import Trained, cache_of, copied, trained_once
from wheelleg_exp.run.run_directory import RunDirectory


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True, scope="module")
def _cache_and_threads(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Set the cache folder before the fixtures of a module, and restore the number of threads after its tests."""
    before = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
        yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return trained_once(tmp_path_factory)


@pytest.fixture
def run(trained: Trained, tmp_path: Path) -> RunDirectory:
    return copied(trained, tmp_path)
