"""Hostile recordings through the commands: an answer or an error for people, within bounds, and nothing else."""

from __future__ import annotations

import json
import os
import re
import resource
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest
from hostile import BOX, ESCAPES, HOSTILE, OUTSIDE, pose, whole
from rrd import END, HEADER, ROWS, SIM_TIME, STEP, STORE_INFO, announced, healthy, lists, message, numbers, rows, static

from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection import recording_video
from wheelleg_exp.inspection.plot_data import Source
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing.resume_recording import resume_problem

pytestmark = pytest.mark.slow

_ORDERS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")
_ROOM = 2 << 30  # bytes beyond what the process has


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The current folder, which holds nothing but a healthy recording."""
    made = tmp_path / "here"
    made.mkdir()
    (made / "healthy.rrd").write_bytes(healthy())
    monkeypatch.chdir(made)
    return made


@pytest.fixture
def bounded() -> Iterator[None]:
    """Let this process have no more memory than a little beyond what it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 1 << 24
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + _ROOM, hard))
    yield
    resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def answered(capsys, *words: str | Path) -> str:
    """Run a command and return what it printed, which must be an answer or an error for people."""
    status = main([str(word) for word in words])
    said = capsys.readouterr()
    assert status in (0, 1, 2), said.err
    assert "Traceback" not in said.err
    assert "--debug" not in said.err
    assert not _ORDERS.search(said.out + said.err)
    if "--json" in words and status != 2:
        assert isinstance(json.loads(said.out), dict)
    return said.out + said.err


def files(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("name", HOSTILE)
def test_looking_at_it_ends_in_an_answer_or_an_error_for_people(name, folder, capsys):
    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    answered(capsys, "inspect", "x.rrd", "--summary", "--names", "--export", "csv", "-o", "out")
    answered(capsys, "inspect", "x.rrd", "--json", "--stats", "--where", "base.height > 0.15", "--term", "base.height")
    answered(capsys, "inspect", "healthy.rrd", "--compare", "x.rrd", "--limit", "3")
    resume_problem(Path("x.rrd"))  # as a resume asks
    outside = [path for path in files(folder.parent) if not path.startswith("here")]
    assert outside == []
    assert {path.split("/")[0] for path in files(folder)} <= {"healthy.rrd", "x.rrd", "out"}
    assert not Path("/tmp/outside.csv").exists()


DRAWN = [
    "a path of escapes",
    "words of escapes",
    "numbers that are not finite",
    "numbers that are nothing",
    "times that are numbers",
    "no times",
]


@pytest.mark.parametrize("name", DRAWN)
def test_its_curves_are_drawn_or_it_is_told_why_not(name, folder, capsys):
    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    answered(capsys, "inspect", "x.rrd", "--plot", "p.svg")
    if (folder / "p.svg").exists():
        assert not _ORDERS.search((folder / "p.svg").read_text("utf-8"))
    assert "outside" not in files(folder)


SHAPED = [name for name in HOSTILE if name.startswith(("a box", "a capsule", "a mesh", "a pose", "poses", "arrows"))]


@pytest.mark.parametrize("name", SHAPED)
def test_its_robot_is_understood_or_it_is_told_why_not(name, folder):
    from wheelleg_exp.inspection import recording_pictures
    from wheelleg_exp.rendering.scene_models import build_model

    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    try:
        shown = recording_pictures.scenery(Recording(folder / "x.rrd"))
    except WheellegError:
        return
    build_model(shown.scene, 64, 64, 0)
    for row in range(len(shown.motion.step)):
        assert recording_pictures.view(shown, row, shown.motion.pos[row, shown.scene.root], 1.0).pos.size


def test_a_video_without_end_is_refused(folder):
    moments = {STEP: pa.array([1, 2]), SIM_TIME: pa.array([0, 2**62], pa.duration("ns"))}
    (folder / "x.rrd").write_bytes(HEADER + announced() + pose("world/body", 2, moments) + BOX)
    with pytest.raises(WheellegError, match=r"it would have \d+ pictures; expected at most"):
        recording_video.video(Recording(folder / "x.rrd"), folder / "v.mp4", width=64, height=64)
    assert files(folder) == ["healthy.rrd", "x.rrd"]


def test_a_group_that_is_called_like_a_path_is_exported_within_the_folder(folder, capsys):
    (folder / "x.rrd").write_bytes(whole(numbers(f"{OUTSIDE}/b", [1.0]), numbers(r"a\/..\/b/c", [2.0])))
    answered(capsys, "inspect", "x.rrd", "--export", "parquet", "-o", "out")
    assert files(folder / "out") == ["%2ftmp%2foutside.parquet", "a%2f.parquet", "base.parquet"]


def test_what_a_terminal_would_obey_is_shown_as_letters(folder, capsys):
    words = rows("log/events", {"TextLog:text": lists([ESCAPES] * 3)})
    (folder / "x.rrd").write_bytes(whole(words, numbers("terminations/fell", [0.0] * 3), numbers("rewards/a", [1.0])))
    assert r"\x1b]0;owned\x07\x1b[2J\x9b31m\u202egnp.exe\u2066\r\x08" in answered(capsys, "inspect", "x.rrd")
    found = json.loads(answered(capsys, "inspect", "x.rrd", "--json"))
    assert found["summary"]["events"] == {ESCAPES: 3}


def test_a_number_of_another_kind_is_left_out_and_all_else_is_read(folder):
    name = "numbers that are words"
    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    recording = Recording(folder / "x.rrd")
    assert recording.table("rewards").column("total").to_pylist() == [1.0, 2.0, 3.0]
    assert "scalars" not in recording.columns("rewards/odd")
    assert recording.health.damaged == ()


@pytest.mark.parametrize(
    "name", ["unpacked, a gigabyte of zeros", "buffers that Arrow is to unpack", "a path of a megabyte"]
)
def test_what_is_too_large_is_left_out_and_told(name, folder):
    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    recording = Recording(folder / "x.rrd")
    assert recording.values("base/height").ravel().tolist() == [0.1, 0.2, 0.3]
    assert len(recording.health.damaged) == 1


def test_every_text_counts_in_a_digest(folder, monkeypatch):
    """Also of more than are made into Python's own at a time."""
    monkeypatch.setattr("wheelleg_exp.recording.reading.arrow_values.MOST_VALUES", 10)
    monkeypatch.setattr("wheelleg_exp.recording.reading.recording_digest._TOGETHER", 4)
    for i, last in enumerate("ab"):
        content = static("base/height", **{"SeriesLines:names": pa.array([[*"x" * 50, last]])})
        (folder / f"{i}.rrd").write_bytes(whole(content))
    one, other = (entity_digests(folder / f"{i}.rrd") for i in range(2))
    assert one != other


@pytest.mark.usefixtures("bounded")
@pytest.mark.parametrize("kind", [END, STORE_INFO, ROWS])
def test_a_file_with_a_hole_larger_than_all_memory_is_not_read_into_it(kind, folder, capsys):
    (folder / "x.rrd").write_bytes(whole(message(kind, b"", length=1 << 36)))
    os.truncate("x.rrd", (1 << 36) + (1 << 20))
    assert "not whole" in answered(capsys, "inspect", "x.rrd")
    assert Recording(folder / "x.rrd").values("base/height").ravel().tolist() == [0.1, 0.2, 0.3]


@pytest.mark.parametrize("name", ["a config that unfolds without end", "a config that runs a program"])
def test_a_config_in_a_recording_runs_nothing_and_unfolds_nothing(name, folder):
    (folder / "x.rrd").write_bytes(HOSTILE[name]())
    assert Source(Recording(folder / "x.rrd")).target_height() is None
    assert files(folder) == ["healthy.rrd", "x.rrd"]


@pytest.mark.parametrize(
    "make",
    [os.mkfifo, os.mkdir, lambda path: Path(path).symlink_to("/dev/zero"), lambda path: Path(path).symlink_to(path)],
)
def test_what_is_no_file_is_told_and_never_waited_for(make, folder, capsys):
    make("x.rrd")
    for words in ([], ["--compare", "healthy.rrd"], ["--repair"]):
        assert "x.rrd" in answered(capsys, "inspect", "x.rrd", *words)
