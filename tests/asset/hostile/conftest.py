"""Fixture for a temporary folder with hostile robot files."""

from pathlib import Path

import pytest

from .scratch import Scratch


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scratch:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path / "out" / "cache"))
    return Scratch(tmp_path)
