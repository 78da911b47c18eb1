"""Read ``iterations.jsonl``: one line for each training iteration, and the problems of the file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypedDict

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_lines
from wheelleg_exp.plain_data import json_value
from wheelleg_exp.run.records import read_record

# Scalars with the prefix ``Perf/`` are wall-clock times, which differ even between two equal runs.
_TIMES = "Perf/"


class _DigestFormat(TypedDict, total=False):
    digest_format: int


class LogLine(_DigestFormat):
    """One line of ``iterations.jsonl``: ``digests`` maps names to hashes, computed as in ``digest_format``."""

    iteration: int
    digests: Mapping[str, str]
    scalars: Mapping[str, object]


@dataclass(frozen=True)
class Line:
    """One iteration of ``iterations.jsonl``."""

    iteration: int
    digests: Mapping[str, str]  # ``digests`` maps names to hashes.
    scalars: Mapping[str, object]  # The scalars of the training iteration by name, without wall-clock times.
    digest_format: int | None  # ``digest_format`` is the version of the hash algorithm of ``digests``.
    content: LogLine = field(repr=False)  # The whole log line.
    end: int  # ``end`` is the byte offset in ``iterations.jsonl`` at which the iteration's line ends.


def comparable_digests(line: Line, digest_format: int | None) -> dict[str, str]:
    """Return the digests (hashes) of a log line that can be compared with digests of the format ``digest_format``.

    In format 2, the environment's state has another layout than in format 1; all other digests are the same.
    """
    if line.digest_format == digest_format:
        return dict(line.digests)
    alike = {line.digest_format, digest_format} == {1, 2}
    return {name: digest for name, digest in line.digests.items() if alike and name != "environment"}


@dataclass(frozen=True)
class IterationLog:
    """The iterations in a run's log file, without gaps (``lines[i].iteration == i``), and the file's problems."""

    lines: list[Line] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    cut_off: bool = False  # True if the last log line has no newline, for example after a crash.


def read_log(path: Path) -> IterationLog:
    """Read an iteration log up to the log's first damaged line; return an empty log for a missing file."""
    if not path.is_file():
        return IterationLog(problems=[f"there is no {path.name}"])
    log, end = IterationLog(), 0
    for number, raw in enumerate(read_lines(path), start=1):
        if not raw.endswith(b"\n"):
            return replace(log, cut_off=True)
        end += len(raw)
        content, expected = read_line(raw), len(log.lines)
        if content is None:
            log.problems.append(f"line {number} cannot be read")
        elif content["iteration"] == expected:
            scalars = {name: value for name, value in content["scalars"].items() if not name.startswith(_TIMES)}
            form = content.get("digest_format")
            log.lines.append(Line(expected, content["digests"], scalars, form, content, end))
            continue
        else:
            kind, found = "repeats" if content["iteration"] < expected else "leaves a gap:", content["iteration"]
            log.problems.append(f"line {number} {kind} iteration {found}, where {expected} was expected")
        break  # Ignore log lines after a damaged line, because their iteration numbers can be wrong.
    return log


def seconds_of(lines: Iterable[Mapping[str, Any]]) -> float:
    """Return the time, s, that a run spent in training iterations, without setup, export, and pauses."""
    times = [line["scalars"].get(_TIMES + key) for line in lines for key in ("collection_time", "learning_time")]
    return float(sum(value for value in times if isinstance(value, (int, float))))


def read_line(raw: bytes) -> LogLine | None:
    """Return one line of an iteration log; None for a damaged line."""
    try:
        return read_record(LogLine, json_value(raw), "broken line", "iterations.jsonl")
    except (ValueError, RunDirectoryError):
        return None
