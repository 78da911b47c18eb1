"""Read ``iterations.jsonl``: one line per iteration, and the problems of the file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from wheelleg_exp.files import read_lines
from wheelleg_exp.plain_data import json_value

# Wall-clock times: the only scalars that differ between two equal runs.
_TIMES = "Perf/"


@dataclass(frozen=True)
class Line:
    """One iteration.

    Attributes:
        iteration: its number, from 0.
        digests: short digests by name.
        scalars: numbers by name, without wall-clock times.
        digest_format: number of the digests' definition; None when the line does not contain it.
        content: the whole line, wall-clock times included.
        end: the position in the file at which it ends.
    """

    iteration: int
    digests: dict[str, str]
    scalars: dict[str, Any]
    digest_format: int | None = None
    content: Mapping[str, Any] = field(default_factory=dict, repr=False)
    end: int = 0


@dataclass(frozen=True)
class IterationLog:
    """The consecutive iterations of a run from 0 on.

    Attributes:
        lines: the iterations, ``lines[i].iteration == i``.
        problems: the problems of the file, with line numbers.
        cut_off: whether the last line has no newline, as after a crash.
    """

    lines: list[Line] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    cut_off: bool = False


def read_log(path: Path) -> IterationLog:
    """Read a log up to its first problem; a missing file has no iterations.

    Raises:
        RunDirectoryError: the file cannot be read.
    """
    if not path.is_file():
        return IterationLog(problems=[f"there is no {path.name}"])
    log, end = IterationLog(), 0
    for number, raw in enumerate(read_lines(path), start=1):
        if not raw.endswith(b"\n"):
            return replace(log, cut_off=True)
        end += len(raw)
        line = _parse(raw, end)
        expected = len(log.lines)
        if line is None:
            log.problems.append(f"line {number} cannot be read")
        elif line.iteration == expected:
            log.lines.append(line)
            continue
        else:
            log.problems.append(_out_of_order(number, line.iteration, expected))
        break  # later lines could belong to another iteration
    return log


def seconds_of(lines: Iterable[Mapping[str, Any]]) -> float:
    """Return the duration of iterations in s, without building, exporting, and the pauses before a resume."""
    times = [line["scalars"].get(_TIMES + key) for line in lines for key in ("collection_time", "learning_time")]
    return float(sum(value for value in times if isinstance(value, (int, float))))


def _out_of_order(number: int, iteration: int, expected: int) -> str:
    kind = "repeats" if iteration < expected else "leaves a gap:"
    return f"line {number} {kind} iteration {iteration}, where {expected} was expected"


def _parse(raw: bytes, end: int) -> Line | None:
    try:
        value = json_value(raw)
        if type(value["iteration"]) is not int:
            return None
        return Line(
            iteration=value["iteration"],
            digests={str(name): str(digest) for name, digest in value["digests"].items()},
            scalars={str(k): v for k, v in value["scalars"].items() if not k.startswith(_TIMES)},
            digest_format=value.get("digest_format"),
            content=value,
            end=end,
        )
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
