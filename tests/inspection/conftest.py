from pathlib import Path

import pytest
from inspection.written import write_recording

from wheelleg_exp.recording.reading.recording_reader import Recording


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("written")


@pytest.fixture(scope="session")
def played(written: Path) -> Recording:
    return Recording(write_recording(written / "played.rrd"))


@pytest.fixture(scope="session")
def trained(written: Path) -> Recording:
    return Recording(write_recording(written / "trained.rrd", training=True))


@pytest.fixture(scope="session")
def several(written: Path) -> Recording:
    return Recording(write_recording(written / "several.rrd", env_ids=(0, 3)))
