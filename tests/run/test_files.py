import errno
import json
import os
import resource
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from wheelleg_exp import files
from wheelleg_exp.errors import RunDirectoryError, SimulationFailure


def test_a_file_and_its_missing_folders_are_written_and_no_temporary_file_stays(tmp_path):
    path = tmp_path / "a" / "b" / "c.txt"
    files.write_text(path, "größe\n")
    assert path.read_bytes() == "größe\n".encode()
    files.write_bytes(path, memoryview(b"new"))
    assert (path.read_bytes(), [p.name for p in path.parent.iterdir()]) == (b"new", ["c.txt"])
    with pytest.raises(RunDirectoryError, match="cannot write"):
        files.write_text(path / "x" / "y.txt", "")  # A parent is a file.


def test_a_failed_write_leaves_the_old_file_whole_and_no_temporary_file(tmp_path):
    path = tmp_path / "model.pt"
    files.write_bytes(path, b"old")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # The kernel refuses larger files, like a full disk does.
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    try:
        with pytest.raises(SimulationFailure, match=r"cannot write '.*model\.pt'") as caught:
            files.write_bytes(path, bytes(2_000_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (caught.value.exit_code, path.read_bytes()) == (3, b"old")
    assert [p.name for p in tmp_path.iterdir()] == ["model.pt"]


def test_the_data_is_on_the_disk_before_the_name_points_to_it(tmp_path, monkeypatch):
    order = []
    fsync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (order.append("sync"), fsync(fd))[1])
    monkeypatch.setattr(Path, "replace", lambda a, b: (order.append("replace"), replace(a, b))[1])
    files.write_bytes(tmp_path / "x", b"1")
    assert order[:2] == ["sync", "replace"]


@pytest.mark.parametrize(
    ("code", "kind", "status"),
    [
        *((code, SimulationFailure, 3) for code in (errno.ENOSPC, errno.EDQUOT)),
        *((code, RunDirectoryError, 2) for code in (errno.EACCES, errno.EROFS, errno.EPERM)),
    ],
)
def test_a_full_disk_fails_the_run_and_a_missing_permission_is_wrong_input(code, kind, status):
    error = files.file_error(Path("x"), OSError(code, "no"))
    assert isinstance(error, kind)
    assert error.exit_code == status


def test_json_takes_numpy_scalars_arrays_paths_nan_and_odd_names(tmp_path):
    name, nan = os.fsdecode(b"\xff.txt"), [float("nan"), float("inf"), -np.float64("inf")]
    value = {"a": np.float32(0.5), "b": np.arange(3), "c": Path("x/y"), "d": np.int64(7)}
    value |= {"e": (1, 2), "f": nan, "g": name}

    def refuse(word):
        raise AssertionError(word)

    files.write_json(tmp_path / "x.json", value)
    read = json.loads((tmp_path / "x.json").read_text(), parse_constant=refuse)
    nan = ["nan", "inf", "-inf"]
    assert read == {"a": 0.5, "b": [0, 1, 2], "c": "x/y", "d": 7, "e": [1, 2], "f": nan, "g": name}
    with pytest.raises(TypeError, match="object"):
        files.dump_json({"a": object()})


BROKEN_JSON = {
    "nested without end": b"[" * 100_000,
    "mappings without end": b'{"a":' * 100_000,
    "a number of thousands of digits": b"9" * 5000,
    "a number that is none": b"[NaN]",
    "a key twice": b'{"a": 1, "a": 2}',
    "no text": b'"\xff"',
    "nothing": b"",
}
BROKEN_YAML = {
    "nested without end": b"[" * 100_000,
    "mappings without end": b"{a: " * 100_000,
    "a number of thousands of digits": b"a: " + b"9" * 5000,
    "a key twice": b"a: 1\na: 2\n",
    "a key that is none": b"? []\n: 1\n",
    "no text": b"a: \xff\xfe\xfa",
    "no truth": b"a: !!bool x",
    "a call": b"a: !!python/object/apply:os.getcwd []",
    "a reference to itself": b"a: &x [*x]",
    "what grows without bound": b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n",
}
CASES = [("x.json", content) for content in BROKEN_JSON.values()] + [("x.yaml", x) for x in BROKEN_YAML.values()]


@pytest.mark.parametrize(("name", "content"), CASES, ids=[*BROKEN_JSON, *BROKEN_YAML])
def test_a_foreign_file_is_read_or_reported(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    kind = name[2:].upper()
    with pytest.raises(RunDirectoryError, match=rf"broken {kind}: .*{name}") as caught:
        (files.read_json if kind == "JSON" else files.read_yaml)(tmp_path / name)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(("name", "text"), [("x.json", '{\n "a": 1,\n oops\n}'), ("x.yaml", "a: 1\nb: [1, 2\nc: 3\n")])
def test_broken_text_is_reported_with_its_line(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(RunDirectoryError, match=rf"broken {name[2:].upper()}.*{name}:3"):
        (files.read_json if name == "x.json" else files.read_yaml)(tmp_path / name)


def test_a_file_above_the_size_limit_is_refused_without_being_read(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"abc")
    tracemalloc.start()
    assert (files.read_bytes(path, 3), files.read_text(path)) == (b"abc", "abc")
    os.truncate(path, (64 << 20) + 1)  # A sparse file uses no space on the disk.
    with pytest.raises(RunDirectoryError, match="has more than 64 MiB") as caught:
        files.read_bytes(path, 64 << 20)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 1 << 20
    assert caught.value.key == str(path)
    system = Path("/proc/self/status")  # Its size is 0.
    assert b"Threads" in files.read_bytes(system)
    with pytest.raises(RunDirectoryError, match="has more than"):
        files.read_bytes(system, 10)
