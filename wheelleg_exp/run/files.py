"""Writing files whole or not at all, and their digests."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from wheelleg_exp.errors import RunDirectoryError, SimulationFailure, WheellegError
from wheelleg_exp.run.plain_yaml import dump_yaml

_DEVICE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
TEMPORARY_SUFFIX = ".tmp"


def file_error(path: Path, error: OSError, verb: str = "write") -> WheellegError:
    """Return the error for people: a full or broken disk fails the run, anything else is wrong input."""
    reason = os.strerror(error.errno).lower() if error.errno else str(error)
    message = f"cannot {verb} '{path}': {reason}"
    if error.errno in _DEVICE_ERRORS:
        return SimulationFailure(message, expected="room on a working disk")
    return RunDirectoryError(message, expected=f"a place that this user may {verb}")


@contextlib.contextmanager
def for_people(path: Path, verb: str = "write") -> Iterator[None]:
    """Turn an OSError of the body into an error for people that names ``path``."""
    try:
        yield
    except OSError as error:
        raise file_error(path, error, verb) from error


def write_bytes(path: Path, data: bytes | bytearray | memoryview) -> None:
    """Write ``data`` to ``path``, so that a reader sees the old file or the whole new one.

    Missing folders are made. The data is on the disk (fsync) before the name points to it.

    Raises:
        SimulationFailure: the disk is full or broken.
        RunDirectoryError: the place cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}{TEMPORARY_SUFFIX}")
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


def write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8, whole or not at all (raises as ``write_bytes``)."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, whole or not at all (raises as ``write_bytes``).

    Key order is kept. Arrays, tensors and numpy scalars become lists and numbers, paths become text, and
    NaN and infinities, which JSON does not have, become ``"nan"``, ``"inf"`` and ``"-inf"``.

    Raises:
        TypeError: a value that is none of these.
    """
    write_text(path, dump_json(value))


def write_yaml(path: Path, value: Any) -> None:
    """Write a plain value as YAML that ``yaml.safe_load`` reads back equal, whole or not at all.

    Raises:
        RunDirectoryError: the value holds something that is not plain, and as ``write_bytes``.
    """
    write_text(path, dump_yaml(value))


def dump_json(value: Any) -> str:
    """Return ``value`` as the text that ``write_json`` writes."""
    plain = json_plain(value)
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:  # a file name that is no UTF-8 was decoded with surrogates
        text = json.dumps(plain, indent=2, allow_nan=False) + "\n"
    return text


def json_plain(value: Any) -> Any:
    """Return ``value`` as mappings, lists, text, finite numbers, booleans and None."""
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
    if hasattr(value, "tolist"):  # numpy and torch, without importing either
        return json_plain(value.tolist())
    raise TypeError(f"{type(value).__name__} cannot be written as JSON")


def read_json(path: Path) -> Any:
    """Return the JSON value in ``path``.

    Raises:
        RunDirectoryError: the file cannot be read or is no JSON, with the line.
    """
    with for_people(path, "read"):
        data = path.read_bytes()
    try:
        return json.loads(data)
    except json.JSONDecodeError as error:
        raise RunDirectoryError(f"broken JSON: {error.msg}", where=f"{path}:{error.lineno}") from error
    except UnicodeDecodeError as error:
        raise RunDirectoryError("broken JSON: it is not UTF-8 text", where=str(path)) from error


def read_yaml(path: Path) -> Any:
    """Return the plain YAML value in ``path``.

    Raises:
        RunDirectoryError: the file cannot be read or is no plain YAML, with the line.
    """
    with for_people(path, "read"):
        data = path.read_bytes()
    try:
        return yaml.load(data, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"{path}:{mark.line + 1}" if mark else str(path)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise RunDirectoryError(f"broken YAML: {problem}", where=where) from error


def sha256(path: Path) -> str:
    """Return the sha256 of a file's content, as 64 hexadecimal digits.

    Raises:
        RunDirectoryError: the file cannot be read.
    """
    with for_people(path, "read"), path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def temporaries(folder: Path, *, deep: bool = False) -> list[Path]:
    """Return what a killed writer has left half written in a folder, or anywhere below it when ``deep``."""
    pattern = f".*{TEMPORARY_SUFFIX}"
    return sorted(folder.rglob(pattern) if deep else folder.glob(pattern))


def sync_folder(folder: Path) -> None:
    """Bring every file below a folder, and the names that lead to it, to the disk: it outlives a power cut."""
    for path in sorted(folder.rglob("*")):
        _sync(path)
    for place in (folder, folder.parent, folder.parent.parent):
        _sync(place)


def _sync(path: Path) -> None:
    # Not every file system can sync a folder, and none must.
    with contextlib.suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
