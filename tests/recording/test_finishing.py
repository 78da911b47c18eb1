from pathlib import Path
from types import SimpleNamespace

import pytest
from patience import PATIENCE_S

from wheelleg_exp.recording import rerun_program


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "r.rrd"
    path.write_bytes(b"as it is")
    return path


@pytest.mark.parametrize(
    ("script", "why"),
    [
        ("echo first >&2; echo 'no such chunk' >&2; exit 1", "no such chunk"),
        ("exit 3", "rerun exited with status 3"),
        ("exit 0", "rerun wrote nothing"),
        ('echo "no recording" > "$5"', "rerun wrote nothing"),
        ("sleep 600", "rerun did not finish within 0 s"),
        ("", "Rerun's program is missing"),
    ],
)
def test_an_error_of_rerun_is_reported_and_the_file_stays(path, monkeypatch, script, why):
    program = path.with_name("rerun")
    program.write_text(f"#!/bin/sh\n{script.replace('sleep', 'exec sleep')}\n")
    program.chmod(0o755)
    missing = program.with_name("missing")
    monkeypatch.setattr(rerun_program, "rerun_program", lambda: str(program if script else missing))
    monkeypatch.setattr(rerun_program, "_TIMEOUT_S", 0.3 if "sleep" in script else PATIENCE_S)
    assert rerun_program.optimize_recording(path) == why
    assert path.read_bytes() == b"as it is"
    assert sorted(p.name for p in path.parent.iterdir()) == ["r.rrd", "rerun"]


def test_a_disk_without_room_for_the_copy_is_named(path, monkeypatch):
    monkeypatch.setattr(rerun_program, "rerun_program", lambda: "false")
    monkeypatch.setattr(rerun_program.shutil, "disk_usage", lambda folder: SimpleNamespace(free=3))
    assert rerun_program.optimize_recording(path) == "the disk has no room for a second copy"
    assert path.read_bytes() == b"as it is"
