"""``manifest.json``: what a run is, how it ended, and the digest of every file that it wrote.

The last key of the file, ``sha256``, is the digest of the file's own bytes, so that a changed byte is detected.
The type of every value is checked before the value is used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.files import dump_json, for_people, json_plain, read_json, sha256, write_text
from wheelleg_exp.run import environment
from wheelleg_exp.run.file_inventory import (
    MANIFEST_NAME,
    FileFindings,
    FileRecord,
    compare_files,
    inventory,
    is_inside,
    record_files,
)
from wheelleg_exp.run.run_lock import MANIFEST_LOCK, RunLock, this_process
from wheelleg_exp.run.timestamps import parse_utc, utc_now, utc_text
from wheelleg_exp.user_exceptions import is_interrupt


@dataclass(frozen=True)
class Optional:
    """The type of a value that can be missing or null."""

    kind: Any


def mistyped_keys(value: Any, kind: Any, path: str = "") -> Iterator[str]:
    """Yield the keys at or below ``path`` whose values have the wrong type.

    Args:
        value: a plain value.
        kind: a type; ``[kind]`` for a list; ``{str: kind}`` for a mapping with any keys, else the types by key. A key
            without a type can have any value.
        path: the key of the value.
    """
    if isinstance(kind, Optional):
        if value is not None:
            yield from mistyped_keys(value, kind.kind, path)
    elif isinstance(kind, list) and isinstance(value, list):
        for index, item in enumerate(value):
            yield from mistyped_keys(item, kind[0], f"{path}[{index}]")
    elif isinstance(kind, dict) and isinstance(value, dict):
        kinds = dict.fromkeys(value, kind[str]) if str in kind else kind
        for key, inner in kinds.items():
            yield from mistyped_keys(value.get(key), inner, f"{path}.{key}" if path else str(key))
    elif not isinstance(kind, type) or not _is_instance(value, kind):
        yield path


def _is_instance(value: Any, kind: type) -> bool:
    return kind is bool if isinstance(value, bool) else isinstance(value, kind)


FORMAT = 2
FORMAT_WITH_VALUE_DIGEST = 1  # its digest, if any, is of the values and not of the bytes
STATUSES = ("running", "finished", "interrupted", "failed")


_FILES = {str: {"sha256": str, "size": int}}
WRITER = {
    "pid": Optional(int),
    "host": Optional(str),
    "boot_id": Optional(str),
    "start_ticks": Optional(int),
}  # a process
_PROCESS: dict[Any, Any] = {
    "error": Optional({"type": Optional(str), "message": Optional(str)}),
    "ended": Optional(str),
    "process": Optional(WRITER),
    "failure": Optional({"key": Optional(str), "iteration": int, "message": str}),
    "versions": Optional(dict),
    "hardware": Optional(dict),
    "threads": Optional(dict),
    "environment_variables": Optional({str: str}),
}
_RESULTS = {"non_finite": Optional({str: int})}
_RESUME = {
    "when": Optional(str),
    "iteration": Optional(int),
    "command": Optional([str]),
    "overrides": Optional([str]),
    "changes": Optional([dict]),
    "why": Optional([str]),
    "notes": Optional([str]),
    "proved": Optional(list),
    "differences": Optional([dict]),
    "before": Optional({**_PROCESS, "files": Optional(_FILES)}),
    "files_to_write": Optional({str: str}),
}
_MANIFEST = {
    **_PROCESS,
    "status": str,
    "task": str,
    "started": str,
    "results": _RESULTS,
    "resumes": [_RESUME],
    "additions": [{"kind": Optional(str), "when": str, "files": _FILES, "results": Optional(_RESULTS)}],
    "files": _FILES,
    "id": Optional(str),
    "command": Optional([str]),
    "working_directory": Optional(str),
    "seeds": Optional(list),
    "source": Optional(dict),
    "engine": Optional(dict),
    "config_dirs": Optional([str]),
    "config_variables": Optional({str: str}),
    "recording_unfinished": Optional(str),
    "replay_of": Optional(str),
    "replay": Optional(dict),
    "ranks": Optional({"world_size": int, "backend": Optional(str), "seeds": Optional(list)}),
}


def require_manifest(data: Any, path: Path) -> None:
    """Raise RunDirectoryError unless ``data``, read from ``path``, is a manifest of a known format."""
    where = os.fspath(path)
    if not isinstance(data, dict) or "format" not in data:
        raise RunDirectoryError("this is not a run's manifest", where=where, expected="a mapping with 'format'")
    if type(data["format"]) is not int or data["format"] not in (FORMAT_WITH_VALUE_DIGEST, FORMAT):
        raise RunDirectoryError(
            f"manifest format {data['format']!r} is unknown",
            where=where,
            expected=f"format {FORMAT_WITH_VALUE_DIGEST} or {FORMAT}; a newer wheelleg_exp may read it",
        )
    for wrong in mistyped_keys(data, _MANIFEST):
        raise RunDirectoryError(f"broken manifest: '{wrong}' is missing or wrong", where=where)
    if data["status"] not in STATUSES:
        raise RunDirectoryError(
            f"status '{data['status']}' is not known",
            where=where,
            expected="one of " + ", ".join(STATUSES),
            nearest=nearest_name(data["status"], STATUSES),
        )
    _require_times(data, where)
    _require_inside(data, where)


def _require_times(data: dict[str, Any], where: str) -> None:
    times = [data["started"], *([data["ended"]] if data.get("ended") else [])]
    times += [entry["when"] for entry in data["additions"]]
    for text in times:
        try:
            parse_utc(text)
        except ValueError:
            raise RunDirectoryError(f"broken manifest: {text!r} is not a time", where=where) from None


def _require_inside(data: dict[str, Any], where: str) -> None:
    tables = [data["files"], *(entry["files"] for entry in data["additions"])]
    for entry in data["resumes"]:
        tables += [entry.get("files_to_write") or {}, (entry.get("before") or {}).get("files") or {}]
    for name in (name for table in tables for name in table):
        if not is_inside(name):
            raise RunDirectoryError(f"the manifest names {name!r}, which is outside its directory", where=where)


DIGEST_KEY = "sha256"
_NO_DIGEST = "0" * 64
_END = re.compile(rb'"sha256": "([0-9a-f]{64})"\n\}\n\Z')


def text_with_digest(document: Mapping[str, Any], *, broken: bool = False) -> str:
    """Return the document as JSON whose last key, ``sha256``, is the digest of all bytes of the text.

    The digest is computed of the text with 64 zeros in place of the digest. An earlier digest is replaced.

    Args:
        document: the content.
        broken: whether to write zeros as the digest, because the old document did not match its digest.
    """
    text = dump_json({**_without_digest(document), DIGEST_KEY: _NO_DIGEST})
    digest = _NO_DIGEST if broken else hashlib.sha256(text.encode("utf-8")).hexdigest()
    head, _, tail = text.rpartition(_NO_DIGEST)
    return f"{head}{digest}{tail}"


def bytes_match_digest(data: bytes) -> bool:
    """Return whether bytes are, byte for byte, a text that ``text_with_digest`` returned."""
    found = _END.search(data)
    if found is None:
        return False
    unsealed = data[: found.start(1)] + _NO_DIGEST.encode() + data[found.end(1) :]
    return hashlib.sha256(unsealed).hexdigest() == found.group(1).decode()


def values_match_digest(document: Mapping[str, Any]) -> bool | None:
    """Return whether the values of a document of format 1 match its digest; None when it has no digest.

    A change that keeps the values is not detected, such as other last digits of a number that round alike.
    """
    if DIGEST_KEY not in document:
        return None
    text = json.dumps(json_plain(_without_digest(document)), sort_keys=True, allow_nan=False)
    return document[DIGEST_KEY] == hashlib.sha256(text.encode()).hexdigest()


def _without_digest(document: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in document.items() if key != DIGEST_KEY}


Ended = Literal["finished", "interrupted", "failed"]

# Files that are written before the first step and never again; all other files can grow during the run.
SNAPSHOT = (".hydra/", "params/", "source/", "asset/", "environment.txt")

# Keys that a resume replaces; their old values are stored in ``resumes``.
_PROCESS_KEYS = (
    "status",
    "error",
    "ended",
    "process",
    "versions",
    "hardware",
    "threads",
    "environment_variables",
    "files",
)

_LOCK_TIMEOUT_S = 20.0
_PENDING = "files_to_write"  # the key of a resume that has not yet written its changed files


@dataclass
class Manifest:
    """The manifest of one run directory. Every change reads, modifies and replaces the file under a lock.

    Args:
        path: the manifest file.
        data: the content that was last read or written.
    """

    path: Path
    data: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def begin(
        cls,
        directory: Path,
        *,
        task: str,
        seed: int | Sequence[int],
        command: Sequence[str],
        threads: Mapping[str, Any],
        now: datetime | None = None,
    ) -> Manifest:
        """Write the first manifest of a run, with status ``running`` and the present files.

        Raises:
            RunDirectoryError: the directory already has a manifest.
        """
        path = directory / MANIFEST_NAME
        if path.exists():
            raise RunDirectoryError(f"'{directory}' already contains a run", expected="a new run directory")
        manifest = cls(path)
        manifest.data = {
            "format": FORMAT,
            "id": directory.name,
            "task": task,
            "status": "running",
            "error": None,
            "command": list(command),
            "working_directory": str(Path.cwd()),
            "started": utc_text(now or utc_now()),
            "ended": None,
            "seeds": [seed] if isinstance(seed, int) else list(seed),
            "process": this_process(),
            "versions": environment.versions(),
            "hardware": environment.hardware(),
            "threads": dict(threads),
            "environment_variables": environment.variables(),
            "source": {},
            "results": {},
            "resumes": [],
            "additions": [],
            "files": inventory(directory),
        }
        write_text(path, text_with_digest(manifest.data))
        return manifest

    @classmethod
    def load(cls, directory: os.PathLike[str]) -> Manifest:
        """Read the manifest of a run directory.

        Raises:
            RunDirectoryError: the manifest is missing or broken, or its format is unknown.
        """
        path = Path(directory) / MANIFEST_NAME
        if not path.is_file():
            raise RunDirectoryError(f"'{path.parent}' is not a run directory: it has no {MANIFEST_NAME}")
        data = read_json(path)
        require_manifest(data, path)
        return cls(path, data)

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self.path.parent

    @property
    def status(self) -> str:
        """The recorded status, one of ``STATUSES``; that of a killed run is still ``running``."""
        return str(self.data["status"])

    @property
    def started(self) -> datetime:
        """When the run started."""
        return parse_utc(self.data["started"])

    @property
    def results(self) -> dict[str, Any]:
        """The run's results."""
        return self.data["results"]

    def matches_digest(self) -> bool | None:
        """Return whether the file matches its own digest; None for a file of format 1 without a digest.

        Raises:
            RunDirectoryError: the file cannot be read.
        """
        if self.data["format"] == FORMAT_WITH_VALUE_DIGEST:
            return values_match_digest(self.data)
        with for_people(self.path, "read"):
            return bytes_match_digest(self.path.read_bytes())

    def snapshot_taken(self, source: Mapping[str, Any]) -> None:
        """Record that the snapshot is complete: the source, and the present files."""

        def change(data: dict[str, Any]) -> None:
            data["source"] = dict(source)
            data["files"] = inventory(self.directory)

        self._update(change)

    def finish(
        self,
        status: Ended,
        results: Mapping[str, Any] | None = None,
        error: BaseException | str | None = None,
        *,
        now: datetime | None = None,
    ) -> None:
        """Write how the run ended, and the digests of all its files, which must be closed.

        Args:
            status: ``finished``, ``interrupted`` or ``failed``.
            results: added to the present results.
            error: the reason of a failure.
            now: the time of the end; the current time by default.

        Raises:
            ValueError: the status is not one of the three.
        """
        if status not in STATUSES[1:]:
            raise ValueError(f"a run cannot end as '{status}'")

        def change(data: dict[str, Any]) -> None:
            data["status"] = status
            data["error"] = _describe(error)
            data["ended"] = utc_text(now or utc_now())
            data["results"] = {**data["results"], **(results or {})}
            data["files"] = inventory(self.directory)

        self._update(change)

    def restart(
        self,
        *,
        command: Sequence[str],
        threads: Mapping[str, Any],
        now: datetime | None = None,
        texts: Mapping[str, str] | None = None,
        **facts: Any,
    ) -> None:
        """Record that this process resumes the run: status ``running``, and the facts of this machine.

        ``resumes`` stores the old values: status, error, end, process, versions, hardware, threads and digests.

        Args:
            command: the command line of the resume.
            threads: the thread policy of this process.
            now: the time of the resume; the current time by default.
            texts: the new content of the snapshot's files that the resume's overrides change, by relative name.
            facts: more facts about the resume, such as the iteration at which it starts.
        """
        texts = dict(texts or {})

        def change(data: dict[str, Any]) -> None:
            before = {key: data.get(key) for key in _PROCESS_KEYS}
            before |= {"failure": data.pop("failure")} if "failure" in data else {}
            entry = {"when": utc_text(now or utc_now()), "command": list(command), **json_plain(facts)}
            entry |= {"before": before, **({_PENDING: texts} if texts else {})}
            data["resumes"].append(entry)
            data.update(status="running", error=None, ended=None, process=this_process(), threads=dict(threads))
            data.update(versions=environment.versions(), hardware=environment.hardware())
            data["environment_variables"] = environment.variables()
            data["files"] = {k: v for k, v in data["files"].items() if k.startswith(SNAPSHOT)}
            data["files"] |= {name: _text_record(text) for name, text in texts.items()}

        self._update(change)
        self.write_pending()

    def write_pending(self) -> None:
        """Write the changed files of the last resume, unless they were written; a crash may have prevented that."""
        entry = self.data["resumes"][-1] if self.data["resumes"] else {}
        if _PENDING in entry:
            for name, text in entry[_PENDING].items():
                write_text(self.directory / name, text)
            self._update(lambda data: data["resumes"][-1].pop(_PENDING, None))

    def amend_resume(self, **facts: Any) -> None:
        """Add facts to the entry of the last resume."""
        self._update(lambda data: data["resumes"][-1].update(json_plain(facts)))

    def record(self, **facts: Any) -> None:
        """Record facts about the whole run by key, such as the run that it repeats."""
        self._update(lambda data: data.update(facts))

    def add(
        self,
        kind: str,
        files: Iterable[Path] = (),
        results: Mapping[str, Any] | None = None,
        *,
        command: Sequence[str] | None = None,
        now: datetime | None = None,
    ) -> dict[str, Any]:
        """Record the files and results that a later command adds to the run, and return the entry.

        Args:
            kind: such as ``play``, ``evaluation`` or ``export``.
            files: the new files, below the run directory.
            results: the results.
            command: the command line; that of this process by default.
            now: the time of the addition; the current time by default.

        Raises:
            RunDirectoryError: a file is missing or outside the run directory.
        """
        entry: dict[str, Any] = {
            "kind": kind,
            "when": utc_text(now or utc_now()),
            "command": list(sys.argv if command is None else command),
            "files": record_files(self.directory, files),
            "results": dict(results or {}),
        }
        self._update(lambda data: data["additions"].append(entry))
        return self.data["additions"][-1]

    def recorded_files(self) -> dict[str, FileRecord]:
        """Return the newest record of every file, including files of additions."""
        additions = sorted(self.data["additions"], key=lambda entry: parse_utc(entry["when"]))
        ended = parse_utc(self.data["ended"]) if self.data.get("ended") else self.started
        records: dict[str, FileRecord] = {}
        for entry in additions:
            if parse_utc(entry["when"]) <= ended:
                records.update(entry["files"])
        records.update(self.data["files"])
        for entry in additions:
            if parse_utc(entry["when"]) > ended:
                records.update(entry["files"])
        return records

    def matches_record(self, path: Path) -> bool:
        """Return whether a file of the run matches its newest record, or has no record."""
        record = self.recorded_files().get(path.name)
        return record is None or record["sha256"] == sha256(path)

    def compare_files(self) -> FileFindings:
        """Compare the files on the disk with their newest records."""
        return compare_files(self.directory, self.recorded_files())

    @contextlib.contextmanager
    def finishing(self) -> Iterator[dict[str, Any]]:
        """Record the end of the run after the body; the body fills the yielded results.

        Ctrl-C gives the status ``interrupted``, any other exception ``failed``. The exception is raised again, even
        when the manifest cannot be written.
        """
        results: dict[str, Any] = {}
        with self.failing(results):
            yield results
        self.finish("finished", results)

    @contextlib.contextmanager
    def failing(self, results: Mapping[str, Any] | None = None) -> Iterator[None]:
        """Record the end of the run only when the body raises (see ``finishing``)."""
        try:
            yield
        except BaseException as error:
            status: Ended = "interrupted" if is_interrupt(error) else "failed"
            try:
                self.finish(status, results, error)
            except Exception as second:
                error.add_note(f"the manifest could not be written: {second}")
            raise

    def _update(self, change: Callable[[dict[str, Any]], None]) -> None:
        with RunLock(self.directory, name=MANIFEST_LOCK, timeout_s=_LOCK_TIMEOUT_S):
            before = Manifest.load(self.directory)
            was_changed = before.matches_digest() is False  # a new digest would hide the change
            data = before.data
            change(data)
            data["format"] = FORMAT
            text = text_with_digest(data, broken=was_changed)
            write_text(self.path, text)
            self.data = json.loads(text)


def _text_record(text: str) -> FileRecord:
    content = text.encode("utf-8")
    return {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}


def _describe(error: BaseException | str | None) -> dict[str, str] | None:
    if error is None:
        return None
    if isinstance(error, str):
        return {"type": "error", "message": error}
    return {"type": type(error).__name__, "message": str(error)}
