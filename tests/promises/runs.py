"""The run that the code of commit c696ebe trained, packed as test data."""

from __future__ import annotations

import subprocess
import tarfile
from pathlib import Path

import pytest

from .golden import REPOSITORY

OLD_RUN = Path(__file__).with_name("old_run.tar.xz")
OLD_COMMIT = "c696ebe458de39180ff37073a8111d40e05309f5"


def unpack(root: Path) -> Path:
    """Unpack the old run below ``root``, a folder of runs, and return the run directory."""
    with tarfile.open(OLD_RUN) as archive:
        archive.extractall(root, filter="data")
    (run,) = (root / "stand").iterdir()
    return run


def require_old_commit() -> None:
    """Skip the test in a clone whose history does not contain the commit of the old run."""
    found = subprocess.run(["git", "-C", REPOSITORY, "cat-file", "-e", OLD_COMMIT], capture_output=True)
    if found.returncode:
        pytest.skip(f"the commit of the old run, {OLD_COMMIT[:10]}, is not in this clone")
