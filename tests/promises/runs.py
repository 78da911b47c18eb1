"""The run that the code of commit c696ebe trained, packed as test data."""

import json
import subprocess
import tarfile
from pathlib import Path

import pytest

from .golden import REPOSITORY, cpu

OLD_RUN = Path(__file__).with_name("old_run.tar.xz")
OLD_COMMIT = "c696ebe458de39180ff37073a8111d40e05309f5"


def unpack(root: Path) -> Path:
    with tarfile.open(OLD_RUN) as archive:
        archive.extractall(root, filter="data")
    (run,) = (root / "stand").iterdir()
    return run


def of_this_cpu(run: Path) -> bool:
    hardware = json.loads((run / "manifest.json").read_text())["hardware"]
    return cpu() == " ".join(hardware[name] for name in ("cpu", "cpu_family", "cpu_model", "cpu_stepping"))


def require_old_code(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip without the old commit, whose code asks for the version of the package ``mujoco``, and install that name."""
    found = subprocess.run(["git", "-C", REPOSITORY, "cat-file", "-e", OLD_COMMIT], capture_output=True)
    if found.returncode:
        pytest.skip(f"the commit of the old run, {OLD_COMMIT[:10]}, is not in this clone")
    facts = folder / "packages" / "mujoco-4.0.0.dist-info" / "METADATA"
    facts.parent.mkdir(parents=True)
    facts.write_text("Metadata-Version: 2.1\nName: mujoco\nVersion: 4.0.0\n")
    monkeypatch.setenv("PYTHONPATH", str(facts.parents[1]))
