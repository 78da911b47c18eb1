"""Recordings that the tests of looking at recordings share."""

from __future__ import annotations

from pathlib import Path

import pytest
from inspection.written import write_recording

from wheelleg_exp.recording.reading.recording_reader import Recording


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the hand-written recordings."""
    return tmp_path_factory.mktemp("written")


@pytest.fixture(scope="session")
def played(written: Path) -> Recording:
    """A play of one environment."""
    return Recording(write_recording(written / "played.rrd"))


@pytest.fixture(scope="session")
def trained(written: Path) -> Recording:
    """A training with three samples."""
    return Recording(write_recording(written / "trained.rrd", training=True))


@pytest.fixture(scope="session")
def several(written: Path) -> Recording:
    """A play of two environments, 0 and 3."""
    return Recording(write_recording(written / "several.rrd", env_ids=(0, 3)))
