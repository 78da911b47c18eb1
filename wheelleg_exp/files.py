"""Files: atomic writes, truncation of growing files, reading, and digests."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import hashlib
import json
import math
import os
import secrets
import shutil
import stat
from collections.abc import Iterator, Mapping
from io import BufferedReader
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.plain_data import Unreadable, dump_yaml, json_value, yaml_value

_DEVICE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
TEMPORARY_SUFFIX = ".tmp"
# A file that is read completely into memory can have at most 1 GiB, a JSON file 64 MiB, and a YAML file 1 MiB.
_LARGEST, _LARGEST_JSON, LARGEST_YAML = 1 << 30, 1 << 26, 1 << 20


def file_error(path: Path, error: OSError, verb: str = "write") -> WheellegError:
    """Return SimulationFailure for a full or broken disk, and RunDirectoryError for any other OSError."""
    reason = os.strerror(error.errno).lower() if error.errno else str(error)
    message = f"cannot {verb} '{path}': {reason}"
    if error.errno in _DEVICE_ERRORS:
        return SimulationFailure(message, expected="room on a working disk")
    return RunDirectoryError(message, expected=f"a path that this user can {verb}")


@contextlib.contextmanager
def for_people(path: Path, verb: str = "write") -> Iterator[None]:
    """Convert an OSError inside the ``with`` block to a WheellegError that names ``path``."""
    try:
        yield
    except OSError as error:
        raise file_error(path, error, verb) from error


@contextlib.contextmanager
def while_running() -> Iterator[None]:
    """Convert a RunDirectoryError in the ``with`` block to SimulationFailure, because the run has already started."""
    try:
        yield
    except RunDirectoryError as error:
        raise SimulationFailure(
            error.message, key=error.key, where=error.where, expected=error.expected, nearest=error.nearest
        ) from error


def write_bytes(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write ``data`` to ``path`` atomically: a reader sees the old file or the complete new one.

    Missing folders are created. A full or broken disk raises SimulationFailure, any other problem RunDirectoryError.
    """
    temporary = temporary_name(path)
    with for_people(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    _sync(path.parent)


def require_new(path: Path) -> None:
    """Raise RunDirectoryError if ``path`` exists."""
    if path.exists() or path.is_symlink():
        raise RunDirectoryError(f"'{path}' exists and is not overwritten", expected="a path that does not exist")


def write_new(path: Path, content: bytes) -> None:
    """Write a new file atomically; create the file's folder if the folder is missing."""
    require_new(path)
    write_bytes(path, content)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 atomically."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: object) -> None:
    """Write ``value`` as indented JSON atomically.

    Keys keep their order. Arrays, tensors and numpy scalars in ``value`` are written as lists and numbers, and paths as
    text. NaN and infinities, which JSON lacks, become the texts ``"nan"``, ``"inf"`` and ``"-inf"``.
    """
    write_text(path, dump_json(value))


def write_yaml(path: Path, value: object) -> None:
    """Write a plain value atomically as YAML from which ``yaml.safe_load`` restores an equal value."""
    write_text(path, dump_yaml(value))


def dump_json(value: object) -> str:
    """Return ``value`` as the JSON text that ``write_json`` writes."""
    plain = json_plain(value)
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:  # A file name that is not UTF-8 contains surrogates, which UTF-8 cannot encode.
        text = json.dumps(plain, indent=2, allow_nan=False) + "\n"
    return text


def json_plain(value: object) -> Any:
    """Convert ``value`` to nested mappings and lists of text, finite numbers, booleans and None."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Mapping):
        return {str(key): json_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_plain(item) for item in value]
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else repr(float(value))
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # numpy and torch
        return json_plain(value.tolist())
    raise TypeError(f"a value of the type {type(value).__name__} cannot be written as JSON")


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file for reading; raise an error for pipes and devices, because reading them might never end."""
    with for_people(path, "read"), open(path, "rb", opener=_opened) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            message = "the path is not an ordinary file"
            raise RunDirectoryError(message, key=str(path), expected="a file that can be read")
        yield file


def _opened(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # Opening a named pipe must not wait for its writer.


def read_bytes(path: Path, largest: int = _LARGEST) -> bytes:
    """Return the content of a file; raise an error if the file has more than ``largest`` bytes."""
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size  # file.read(n) allocates n bytes even for a smaller file.
        data = b"" if size > largest else file.read(size + 1)
        if len(data) > size:  # Files in /proc, for example, are longer than their reported size.
            data += file.read(largest + 1 - len(data))
    if max(size, len(data)) > largest:
        message = f"the file has more than {largest >> 20} MiB"
        raise RunDirectoryError(message, key=str(path), expected="a file of that size")
    return data


def read_lines(path: Path) -> Iterator[bytes]:
    """Yield the lines of a file, including line ends; a very long line is split into several pieces."""
    with open_file(path) as file:
        while line := file.readline(_LARGEST_JSON):
            yield line


def read_text(path: Path) -> str:
    """Return the text of a file; raise RunDirectoryError if the file is not UTF-8."""
    try:
        return read_bytes(path).decode("utf-8")
    except UnicodeDecodeError as error:
        raise RunDirectoryError("the file is not UTF-8 text", key=str(path)) from error


def read_json(path: Path) -> Any:
    """Return the JSON value in a file; raise RunDirectoryError, which names the line, if the file is not JSON."""
    data = read_bytes(path, _LARGEST_JSON)
    with _naming_file(path, "JSON"):
        return json_value(data)


def read_yaml(path: Path) -> Any:
    """Return the YAML value in a file; raise RunDirectoryError, which names the line, if the file is not plain YAML."""
    data = read_bytes(path, LARGEST_YAML)
    with _naming_file(path, "YAML"):
        return yaml_value(data)


def require_mapping(value: object, path: Path) -> dict[str, object]:
    """Return a value that was read from the file ``path``; raise RunDirectoryError if the value is not a mapping."""
    if not isinstance(value, dict):
        message = f"the file contains a {type(value).__name__}, not a mapping"
        raise RunDirectoryError(message, key=str(path), expected="a mapping")
    return value


@contextlib.contextmanager
def _naming_file(path: Path, kind: str) -> Iterator[None]:
    try:
        yield
    except Unreadable as error:
        where = f"{path}:{error.line}" if error.line else str(path)
        raise RunDirectoryError(f"broken {kind}: {error.problem}", where=where) from error


def sha256(path: Path) -> str:
    """Return the sha256 of a file's content, as 64 hexadecimal digits."""
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporary_name(path: Path) -> Path:
    """Return an unused path next to ``path`` for a file while it is being written; ``temporaries`` finds such files."""
    return path.with_name(f".{path.name}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")


@contextlib.contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """Make a temporary folder next to ``target``; remove it after the ``with`` block unless the block has renamed it.

    A killed process leaves its folder behind; the next call with ``target`` removes folders that no process has locked.
    """
    for left in target.parent.glob(f".{glob.escape(target.name)}.*{TEMPORARY_SUFFIX}"):
        with contextlib.suppress(OSError), _flocked(left):
            shutil.rmtree(left)
    folder = temporary_name(target)
    folder.mkdir(parents=True)
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        with contextlib.suppress(OSError):  # On a file system without locks, folders of killed processes stay.
            stack.enter_context(_flocked(folder))
        yield folder


@contextlib.contextmanager
def _flocked(folder: Path) -> Iterator[None]:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def temporaries(folder: Path, *, deep: bool = False) -> list[Path]:
    """Return the incomplete files that killed processes left in a folder; with ``deep``, search all subfolders."""
    pattern = f".*{TEMPORARY_SUFFIX}"
    return sorted(folder.rglob(pattern) if deep else folder.glob(pattern))


def cut(path: Path, size: int) -> None:
    """Truncate a file to ``size`` bytes, and sync the file's content to the disk."""
    if path.exists():
        with for_people(path):
            os.truncate(path, size)
            _fsync(path)


def sync(path: Path) -> None:
    """Sync the content of a file to the disk, so that a power failure cannot destroy the content."""
    if path.exists():
        with for_people(path):
            _fsync(path)


def sync_folder(folder: Path) -> None:
    """Sync every file below a folder, and the directory entries of the files and the folder, to the disk."""
    for path in sorted(folder.rglob("*")):
        _sync(path)
    for place in (folder, folder.parent, folder.parent.parent):
        _sync(place)


def _sync(path: Path) -> None:
    # Some file systems cannot sync a folder; ignore this harmless error.
    with contextlib.suppress(OSError):
        _fsync(path)


def _fsync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
