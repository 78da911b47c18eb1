"""Repair a recording that was cut off or damaged."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import rerun as rr

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, temporary_name
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP
from wheelleg_exp.recording.reading.journal import Journal
from wheelleg_exp.recording.reading.messages import RECORDING
from wheelleg_exp.recording.reading.recording_contents import Contents, Health, columns
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing import encoding
from wheelleg_exp.recording.writing.encoding import Ids, Store

_TIMEOUT_S = 600.0
_RERUN = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"  # its status is lost with -m


@dataclass(frozen=True)
class Repaired:
    """What became of a recording.

    Attributes:
        path: the recording, which is left as it was.
        output: the mended file; None when there was nothing to mend.
        health: how whole the recording was.
        incomplete: entities of which rerun could not take over every row; mostly none.
        complaint: what rerun's own check still finds in the mended file; None when it finds nothing.
    """

    path: Path
    output: Path | None
    health: Health
    incomplete: tuple[str, ...] = ()
    complaint: str | None = None


def repair(path: Path, output: Path | None = None) -> Repaired:
    """Write what is whole of a recording, with an index at its end, to a file beside it.

    The mended file is held against the recording before it gets its name: it holds every whole row, or it is told of
    which entities it does not. The recording itself is left as it was.

    Args:
        path: the recording.
        output: where to; by default ``<name>.repaired.rrd`` beside it.

    Raises:
        RunDirectoryError: the recording cannot be read at all, or the output exists or cannot be written.
    """
    contents = Contents(path)
    if contents.health.is_whole:
        return Repaired(path, None, contents.health)
    output = output or path.with_name(f"{path.stem}.repaired.rrd")
    _require_free(output)
    with for_people(output):
        output.parent.mkdir(parents=True, exist_ok=True)
    with _beside(output) as kept, _beside(output) as journal, _beside(output) as mended:
        with for_people(output), kept.open("xb") as file:
            file.writelines(contents.kept())
        added = _from_journal(contents)
        if added:
            _write_journal(added, contents, journal)
        _index([kept, journal] if added else [kept], mended, output)
        incomplete, complaint = _incomplete(kept, mended, added), _complaint(mended)
        _name(mended, output)
    return Repaired(path, output, contents.health, tuple(incomplete), complaint)


def _from_journal(contents: Contents) -> dict[str, pa.Table]:
    """Return the rows of training scalars that stand in the journal alone, by entity."""
    journal, found = Journal(contents), {}
    for entity in journal.entities:
        rows = journal.rows_after(entity, [columns(batch) for batch in contents.rows(entity, static=False)])
        if rows is not None and len(rows):
            found[entity] = rows
    return found


def _write_journal(added: Mapping[str, pa.Table], contents: Contents, target: Path) -> None:
    """Write rows of the journal where they belong."""
    ids, store = Ids(), Store(RECORDING, contents.recording_id, contents.application)
    with for_people(target), target.open("xb") as file:
        file.write(encoding.header() + encoding.store_info(store, ids))
        for entity, rows in added.items():
            found = {name: rows.column(name).combine_chunks() for name in (STEP, SIM_TIME, ITERATION, "scalars")}
            scalars = encoding.component(rr.Scalars.descriptor_scalars(), found.pop("scalars"))
            times = [encoding.timeline(name, values) for name, values in found.items()]
            file.write(encoding.new_rows(store, entity, [*times, scalars], ids))


def _index(sources: Sequence[Path], target: Path, output: Path) -> None:
    """Write the messages of files with an index."""
    done = _rerun("merge", "--continue-on-error", *map(str, sources), "-o", str(target))
    with suppress(RunDirectoryError):
        if Recording(target).health.is_closed:  # the status is not zero when a message was left out as well
            return
    raise RunDirectoryError(
        f"cannot write '{output}': {_last_line(done)}", expected="room on the disk, and rows that rerun can read"
    )


def _rerun(*words: str) -> subprocess.CompletedProcess[str]:
    """Run rerun's own program, which may not survive what it reads."""
    command = [sys.executable, "-P", "-c", _RERUN, "rrd", *words]
    try:
        return subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise RunDirectoryError(
            f"rerun did not end within {_TIMEOUT_S:.0f} s", key="--repair", expected="a smaller recording"
        ) from error


def _last_line(done: subprocess.CompletedProcess[str]) -> str:
    return (done.stderr.strip().splitlines() or ["rerun gave no reason"])[-1][:200]


def _complaint(path: Path) -> str | None:
    done = _rerun("verify", str(path))
    return None if done.returncode == 0 else _last_line(done)


def _incomplete(kept: Path, mended: Path, added: Collection[str]) -> list[str]:
    """Return the entities of which a file does not hold the rows of another, and of what was added to it."""
    before, after = (entity_digests(path, without=()) for path in (kept, mended))
    old, new = Recording(kept), Recording(mended)
    wrong = {entity for entity in added if not old.numbers(entity).equals(new.numbers(entity))}
    return sorted(wrong | {e for e, digest in before.items() if e not in added and after.get(e) != digest})


def _require_free(output: Path) -> None:
    if output.exists() or output.is_symlink():
        raise RunDirectoryError(f"'{output}' exists and is not overwritten", expected="a path that is not taken (-o)")


def _name(written: Path, output: Path) -> None:
    """Give a finished file its name, unless the name was taken meanwhile."""
    with for_people(output):
        try:
            os.link(written, output)
        except FileExistsError:
            _require_free(output)
        except OSError:  # a file system without links
            _require_free(output)
            written.replace(output)


@contextmanager
def _beside(output: Path) -> Iterator[Path]:
    """Give a name beside ``output`` that is gone afterwards."""
    path = temporary_name(output)
    try:
        yield path
    finally:
        path.unlink(missing_ok=True)
