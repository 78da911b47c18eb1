"""Other people's libraries around our environments. What is not installed skips: ``nox -s clients`` has it all."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from jobs.small import shared_cache


@pytest.fixture(autouse=True, scope="module")
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with shared_cache(tmp_path_factory, threads=1):
        yield


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "gym", None)  # a folder of tests must not be imported as the library gym
