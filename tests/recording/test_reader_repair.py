from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from inspection.synthetic import Writer, play

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.reading.messages import END, File, spans
from wheelleg_exp.recording.reading.recording_contents import Contents
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.reading.recording_repair import repair


def cut(path, share=0.6):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def verified(path):
    rerun = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"
    words = [sys.executable, "-c", rerun, "rrd", "verify", str(path)]
    return subprocess.run(words, check=False, capture_output=True).returncode == 0


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_mended_recording_holds_every_whole_row_and_passes_rerun_s_own_check(tmp_path):
    path = cut(play(tmp_path / "r.rrd"))
    before = path.read_bytes()
    assert not verified(path)
    done = repair(path)
    assert done.output == tmp_path / "r.repaired.rrd"
    assert verified(done.output)
    assert Recording(done.output).health.lines() == ["whole"]
    assert entity_digests(done.output, without=()) == entity_digests(path, without=())
    assert path.read_bytes() == before
    assert names(tmp_path) == ["r.repaired.rrd", "r.rrd"]


def test_a_damaged_message_is_left_out_and_all_else_is_kept(tmp_path):
    path = play(tmp_path / "r.rrd")
    (piece,) = (p for p in Contents(path).pieces["base/pitch"] if not p.is_static)
    data = bytearray(path.read_bytes())
    data[piece.span.begin + 16 : piece.span.end] = bytes(piece.span.end - piece.span.begin - 16)
    path.write_bytes(data)
    assert b"".join(Contents(path).kept()) == bytes(data[: piece.span.begin] + data[piece.span.end : index_of(path)])
    done = repair(path)
    assert (done.incomplete, done.complaint) == ((), None)
    assert done.health.lost == piece.span.end - piece.span.begin
    assert verified(done.output)
    entities = set(entity_digests(play(tmp_path / "whole.rrd")))
    assert set(entity_digests(done.output)) == entities - {"base/pitch"}


def index_of(path):
    """Return where the index at the end begins."""
    return next(span.begin for span in spans(File(path)) if span.kind == END)


def test_an_existing_file_is_never_overwritten(tmp_path):
    path = cut(play(tmp_path / "r.rrd"))
    (tmp_path / "r.repaired.rrd").write_text("precious")
    with pytest.raises(RunDirectoryError, match="exists and is not overwritten"):
        repair(path)
    with pytest.raises(RunDirectoryError, match="exists and is not overwritten"):
        repair(path, path)
    assert (tmp_path / "r.repaired.rrd").read_text() == "precious"
    assert repair(path, tmp_path / "new" / "other.rrd").output == tmp_path / "new" / "other.rrd"


def test_a_whole_recording_needs_no_mending(tmp_path):
    path = play(tmp_path / "r.rrd")
    assert repair(path).output is None
    assert names(tmp_path) == ["r.rrd"]


def test_what_is_no_recording_cannot_be_mended(tmp_path):
    (tmp_path / "r.rrd").write_bytes(b"RRF2")
    with pytest.raises(RunDirectoryError, match="header"):
        repair(tmp_path / "r.rrd")
    assert names(tmp_path) == ["r.rrd"]


def test_scalars_of_the_journal_are_written_where_they_belong(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    writer.numbers("training/loss", [5.0, 4.0], [10, 20], None, [0, 1])
    writer.numbers("base/height", [0.1, 0.2])
    writer.static("__journal/training", keys=["loss", "new/key"])
    for i, row in enumerate([[5.0], [4.0], [3.0, 7.0], [2.0, 8.0]]):
        writer.numbers("__journal/training", [row], [10 * (i + 1)], None, [i])
    path = writer.kill()
    done = repair(path)
    assert verified(done.output)
    mended = Recording(done.output)
    assert mended.rows("training/loss").column("iteration").to_pylist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(mended.values("training/loss")[:, 0], [5.0, 4.0, 3.0, 2.0])
    np.testing.assert_array_equal(mended.values("training/new/key")[:, 0], [7.0, 8.0])
    assert "training/loss" in mended._contents.pieces
    assert "training/new/key" in mended._contents.pieces
    assert mended.recording_id == "synthetic"
