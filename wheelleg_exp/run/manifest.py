"""``manifest.json`` of a run: its settings, its end, and the digest of every file that the run wrote.

Its last key, ``sha256``, is a hash of the file's own bytes. Every value's type is checked before the value is used.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
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
from wheelleg_exp.run.records import RunRecord, read_record
from wheelleg_exp.run.run_lock import MANIFEST_LOCK, RunLock, this_process
from wheelleg_exp.run.timestamps import parse_utc, utc_now, utc_text
from wheelleg_exp.user_exceptions import is_interrupt

FORMAT = 2
FORMAT_WITH_VALUE_DIGEST = 1  # In manifests of format 1, ``sha256`` is a hash of the values, not of the file's bytes.
STATUSES = ("running", "finished", "interrupted", "failed")

_DIGEST_KEY = "sha256"
_NO_DIGEST = "0" * 64
_END = re.compile(rb'"sha256": "([0-9a-f]{64})"\n\}\n\Z')


def text_with_digest(document: Mapping[str, object], *, broken: bool = False) -> str:
    """Return a document as JSON text that ends with ``sha256``, a hash of the JSON text.

    To compute the hash, ``sha256`` is first set to 64 zeros. If ``broken`` is true, ``sha256`` stays 64 zeros, so that
    no valid hash hides a manual change of the file.
    """
    text = dump_json({**_without_digest(document), _DIGEST_KEY: _NO_DIGEST})
    digest = _NO_DIGEST if broken else hashlib.sha256(text.encode("utf-8")).hexdigest()
    head, _, tail = text.rpartition(_NO_DIGEST)
    return f"{head}{digest}{tail}"


def bytes_match_digest(data: bytes) -> bool:
    """Return whether ``data``, the bytes of a JSON file, match the hash ``sha256`` at the end of the file."""
    found = _END.search(data)
    if found is None:
        return False
    unsealed = data[: found.start(1)] + _NO_DIGEST.encode() + data[found.end(1) :]
    return hashlib.sha256(unsealed).hexdigest() == found.group(1).decode()


def values_match_digest(document: Mapping[str, object]) -> bool | None:
    """Return whether a manifest in the old format 1 matches its own hash; None if the manifest has no hash."""
    # Manifest format 1 hashes rounded numbers, so a change of a number's last digits is not detected.
    if _DIGEST_KEY not in document:
        return None
    text = json.dumps(json_plain(_without_digest(document)), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest() == document[_DIGEST_KEY]


def _without_digest(document: Mapping[str, object]) -> dict[str, object]:
    return {key: value for key, value in document.items() if key != _DIGEST_KEY}


Ended = Literal["finished", "interrupted", "failed"]

# A run writes the files in ``SNAPSHOT`` before its first training step, and does not change them during the training.
SNAPSHOT = (".hydra/", "params/", "source/", "asset/", "environment.txt")

# `wheelleg resume` overwrites the manifest keys in `_PROCESS_KEYS`, and keeps their old values in the key `resumes`.
_PROCESS_KEYS = (
    *("status", "error", "ended", "process", "versions", "hardware", "threads", "environment_variables"),
    "files",
)

_LOCK_TIMEOUT_S = 20.0
# A resume's entry in ``manifest.json`` has the key ``files_to_write`` until all changed config files are written.
_PENDING = "files_to_write"


@dataclass
class Manifest:
    """The manifest of one run directory; a change locks, reads, modifies, and replaces the manifest file.

    ``data`` is the JSON document with all keys, also those of other versions of the program; ``facts`` is its content.
    """

    path: Path
    data: dict[str, Any]
    facts: RunRecord

    @classmethod
    def begin(
        cls,
        directory: Path,
        *,
        task: str,
        seed: int | Sequence[int],
        command: Sequence[str],
        threads: Mapping[str, object],
        now: datetime | None = None,
    ) -> Manifest:
        """Write a run's first manifest, with the status ``running`` and the files that exist in the run directory."""
        path = directory / MANIFEST_NAME
        if path.exists():
            raise RunDirectoryError(f"the folder '{directory}' already contains a run", expected="a new run directory")
        data = {
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
        write_text(path, text_with_digest(data))
        return cls(path, data, _facts(path, data))

    @classmethod
    def load(cls, directory: os.PathLike[str]) -> Manifest:
        """Read the manifest of a run directory; raise RunDirectoryError if the manifest is missing or damaged."""
        path = Path(directory) / MANIFEST_NAME
        if not path.is_file():
            raise RunDirectoryError(f"'{path.parent}' is not a run directory: it has no {MANIFEST_NAME}")
        data = read_json(path)
        where = os.fspath(path)
        if not isinstance(data, dict) or "format" not in data:
            raise RunDirectoryError("the file is not a run manifest", where=where, expected="a mapping with 'format'")
        if type(data["format"]) is not int or data["format"] not in (FORMAT_WITH_VALUE_DIGEST, FORMAT):
            expected = f"format {FORMAT_WITH_VALUE_DIGEST} or {FORMAT}; a newer wheelleg_exp may read it"
            raise RunDirectoryError(f"manifest format {data['format']!r} is unknown", where=where, expected=expected)
        facts = _facts(path, data)
        if facts.status not in STATUSES:
            message, nearest = f"status '{facts.status}' is not known", nearest_name(facts.status, STATUSES)
            raise RunDirectoryError(message, where=where, expected="one of " + ", ".join(STATUSES), nearest=nearest)
        ended = [facts.ended] if facts.ended else []
        for text in (facts.started, *ended, *(entry.when for entry in facts.additions)):
            try:
                parse_utc(text)
            except ValueError:
                raise RunDirectoryError(f"broken manifest: {text!r} is not a UTC time", where=where) from None
        names = [*facts.files, *(name for entry in facts.additions for name in entry.files)]
        for entry in facts.resumes:
            names += [*entry.files_to_write, *(entry.before.files if entry.before else ())]
        for name in names:
            if not is_inside(name):
                raise RunDirectoryError(f"the manifest's file {name!r} is outside the run directory", where=where)
        return cls(path, data, facts)

    @property
    def directory(self) -> Path:
        return self.path.parent

    @property
    def status(self) -> str:
        """The run's status in the manifest, one of ``STATUSES``; a killed run keeps the status ``running``."""
        return self.facts.status

    @property
    def started(self) -> datetime:
        return parse_utc(self.facts.started)

    @property
    def results(self) -> Mapping[str, object]:
        return self.facts.results

    def matches_digest(self) -> bool | None:
        """Return whether the manifest matches its own hash; None if a manifest in the old format 1 has no hash."""
        if self.data["format"] == FORMAT_WITH_VALUE_DIGEST:
            return values_match_digest(self.data)
        with for_people(self.path, "read"):
            return bytes_match_digest(self.path.read_bytes())

    def finish(
        self,
        status: Ended,
        results: Mapping[str, object] | None = None,
        error: BaseException | str | None = None,
        *,
        now: datetime | None = None,
    ) -> None:
        """Write the run's final status and the hashes of its files into the manifest; all files must be closed.

        ``results`` are added to those that exist. ``error`` is the exception that made the run fail.
        """

        def change(data: dict[str, Any]) -> None:
            kind = "error" if isinstance(error, str) else type(error).__name__
            data["status"] = status
            data["error"] = None if error is None else {"type": kind, "message": str(error)}
            data["ended"] = utc_text(now or utc_now())
            data["results"] = {**data["results"], **(results or {})}
            data["files"] = inventory(self.directory)

        self._update(change)

    def restart(
        self,
        *,
        command: Sequence[str],
        threads: Mapping[str, object],
        now: datetime | None = None,
        texts: Mapping[str, str] | None = None,
        **facts: object,
    ) -> None:
        """Record that this process resumes the run: status ``running``, and the facts of this machine.

        ``facts``, and the replaced values, become an entry of ``resumes``. ``texts`` are changed config files by path.
        """
        texts = dict(texts or {})

        def change(data: dict[str, Any]) -> None:
            before = {key: data.get(key) for key in _PROCESS_KEYS}
            before |= {"failure": data.pop("failure")} if "failure" in data else {}
            entry = {"when": utc_text(now or utc_now()), "command": list(command), **json_plain(facts)}
            entry |= {"before": before, **({_PENDING: texts} if texts else {})}
            data["resumes"].append(entry)
            data.update(status="running", error=None, ended=None, process=this_process(), threads=dict(threads))
            data.update(versions=environment.versions(), hardware=environment.hardware(), results={})
            data["environment_variables"] = environment.variables()
            data["files"] = {k: v for k, v in data["files"].items() if k.startswith(SNAPSHOT)}
            for name, content in ((name, text.encode("utf-8")) for name, text in texts.items()):
                data["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}

        self._update(change)
        self.write_pending()

    def write_pending(self) -> None:
        """Write the config files that the last resume changed, unless the resume has already written them."""
        texts = self.facts.resumes[-1].files_to_write if self.facts.resumes else {}
        for name, text in texts.items():
            write_text(self.directory / name, text)
        if texts:
            self._update(lambda data: data["resumes"][-1].pop(_PENDING, None))

    def amend_resume(self, **facts: object) -> None:
        """Add facts to the entry that describes the run's last resume in the manifest."""
        self._update(lambda data: data["resumes"][-1].update(json_plain(facts)))

    def record(self, **facts: object) -> None:
        """Record facts about the whole run in the manifest, such as the id of the run that this run replays."""
        self._update(lambda data: data.update(facts))

    def add(
        self,
        kind: str,
        files: Iterable[Path] = (),
        results: Mapping[str, object] | None = None,
        *,
        command: Sequence[str] | None = None,
    ) -> None:
        """Record the files and results that a command adds to a run that has ended.

        ``kind`` names the command: ``play``, ``evaluation``, or ``export``. ``files`` must be below the run directory.
        """
        words = list(sys.argv if command is None else command)
        entry: dict[str, object] = {"kind": kind, "when": utc_text(utc_now()), "command": words}
        entry |= {"files": record_files(self.directory, files), "results": dict(results or {})}
        self._update(lambda data: data["additions"].append(entry))

    def recorded_files(self) -> dict[str, FileRecord]:
        """Return the newest size and hash of every file of the run, including files that later commands added."""
        # After a training, commands such as `wheelleg play` add sizes and hashes of new files to the manifest.
        ended = parse_utc(self.facts.ended) if self.facts.ended else self.started
        tables = [(parse_utc(entry.when), 0, entry.files) for entry in self.facts.additions]
        tables.append((ended, 1, self.facts.files))
        newest = sorted(tables, key=lambda table: table[:2])
        return {name: record for *_, table in newest for name, record in table.items()}

    def matches_record(self, path: Path) -> bool:
        """Return whether a file of the run matches its newest hash in the manifest; True if there is no hash."""
        record = self.recorded_files().get(path.name)
        return record is None or record["sha256"] == sha256(path)

    def compare_files(self) -> FileFindings:
        """Compare the run's files on the disk with the newest hash of each file in the manifest."""
        return compare_files(self.directory, self.recorded_files())

    @contextlib.contextmanager
    def finishing(self) -> Iterator[dict[str, object]]:
        """At the end of the ``with`` block, record in the manifest that the run has ended.

        The block writes the results into the yielded dictionary. Ctrl-C sets the status ``interrupted``, and any other
        exception ``failed``; the exception is raised again, even if the manifest cannot be written.
        """
        results: dict[str, object] = {}
        with self.failing(results):
            yield results
        self.finish("finished", results)

    @contextlib.contextmanager
    def failing(self, results: Mapping[str, object] | None = None) -> Iterator[None]:
        """If the ``with`` block raises an exception, record in the manifest that the run failed or was interrupted."""
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
            # If a user changed the manifest by hand, write no new hash, because a new hash would hide the change.
            was_changed = before.matches_digest() is False
            data = before.data
            change(data)
            data["format"] = FORMAT
            text = text_with_digest(data, broken=was_changed)
            write_text(self.path, text)
            self.data = json.loads(text)
            self.facts = _facts(self.path, self.data)


def _facts(path: Path, data: object) -> RunRecord:
    return read_record(RunRecord, data, "broken manifest", path)
