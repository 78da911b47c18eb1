"""Export the numbers of a recording for other tools: Parquet with units, or CSV."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import for_people, require_new, temporary_folder, write_new
from wheelleg_exp.inspection.recorded_numbers import TIMES, find_number, frames_for, is_of_env
from wheelleg_exp.inspection.row_selection import Selection, nothing_chosen
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP, unit
from wheelleg_exp.recording.reading.recording_reader import Recording

KINDS = ("parquet", "csv")
ENV = "env"
UNITS_NAME = "units.json"
_LONGEST_NAME = 100
_TIME_UNITS = {STEP: "control steps", SIM_TIME: "s", ITERATION: "iterations"}


@dataclass(frozen=True)
class Exported:
    """A written file: its path, group, and size."""

    path: Path
    group: str
    rows: int
    columns: int


def export(
    recording: Recording,
    kind: str,
    output: Path,
    *,
    terms: Sequence[str] = (),
    selection: Selection | None = None,
) -> list[Exported]:
    """Write the numbers of a recording: a folder with one file per group, or one file of selected numbers.

    Every table has the columns ``step``, ``sim_time`` (s), ``iteration`` in a training, ``env`` if several environments
    were recorded, and one float64 column per number. Parquet stores each column's unit in the field's metadata
    (``unit``), and facts on the recording in the schema's (``wheelleg``). A folder of CSV files has the units in
    ``units.json``. Numbers in CSV keep all bits. NaN is written as ``nan``. An empty field means that the number has no
    row at that step.

    Args:
        recording: the recording.
        kind: ``parquet`` or ``csv``.
        output: the folder, or with ``terms`` the file. It must not exist, and appears only when complete.
        terms: dotted names of the numbers, such as ``rewards.base_height``; empty for all, by group.
        selection: the rows.

    Raises:
        WheellegError: a name, the selection or the path is wrong.
    """
    if kind not in KINDS:
        raise WheellegError(f"'{kind}' is not an export format", key="--export", expected=" or ".join(KINDS))
    require_new(output)
    chosen = Selection() if selection is None else selection
    if terms:
        table = _of_terms(recording, terms, chosen)
        if not len(table) and not chosen.is_all:
            raise nothing_chosen(recording)
        write_new(output, encoded(table, kind))
        return [_exported(output, "terms", table)]
    tables = {group: table for group in _groups(recording) if (table := _of_group(recording, group, chosen)).num_rows}
    if not tables:
        raise nothing_chosen(recording)
    _write_folder(output, tables, kind)
    return [_exported(output / f"{_file_name(group)}.{kind}", group, table) for group, table in tables.items()]


def encoded(table: pa.Table, kind: str) -> bytes:
    """Return a table as the bytes of a file."""
    buffer = io.BytesIO()
    if kind == "parquet":
        pq.write_table(table, buffer, compression="zstd")
    else:
        pacsv.write_csv(table, buffer)
    return buffer.getvalue()


def units(table: pa.Table) -> dict[str, str]:
    """Return the units of a table's columns that have one."""
    found = {field.name: (field.metadata or {}).get(b"unit") for field in table.schema}
    return {name: value.decode() for name, value in found.items() if value}


def _groups(recording: Recording) -> list[str]:
    """Return the top-level groups of numbers."""
    names = (number.split(".")[0] for env_id in recording.env_ids for number in recording.all_numbers(env_id))
    return list(dict.fromkeys(names))


def _of_group(recording: Recording, group: str, selection: Selection) -> pa.Table:
    tables = []
    for env_id in selection.env_ids(recording):
        numbers = {n: v for n, v in recording.all_numbers(env_id).items() if n.split(".")[0] == group}
        if not numbers:
            continue
        table = selection.apply(recording.columns_of(list(numbers.values())))
        table = table.rename_columns([_within(group, name) for name in table.column_names])
        entities = {_within(group, name): number.entity for name, number in numbers.items()}
        is_own = any(is_of_env(number) for number in numbers.values())
        tables.append(_described(table, entities, recording, env_id if is_own else None))
        if not is_own:
            break  # these numbers belong to no environment
    return pa.concat_tables(tables, promote_options="default") if tables else pa.table({})


def _file_name(group: str) -> str:
    """Return a file name for a group. A group of a foreign recording can have any name, even a path."""
    return re.sub(r"[^\w-]", lambda found: f"%{ord(found.group()):02x}", group)[:_LONGEST_NAME] or "%"


def _within(group: str, name: str) -> str:
    """Return a number's name without its group, unless that would be the name of a timeline."""
    short = name.removeprefix(f"{group}.")
    return name if short in (*TIMES, ENV) else short


def _of_terms(recording: Recording, terms: Sequence[str], selection: Selection) -> pa.Table:
    tables = []
    for frames in frames_for(recording, terms, selection):
        entities = {term: find_number(recording, term, frames.env_id).entity for term in terms}
        is_several = len(recording.env_ids) > 1 and frames.env_id is not None
        tables.append(_described(frames.table, entities, recording, frames.env_id if is_several else None))
    return pa.concat_tables(tables, promote_options="default")


def _described(table: pa.Table, entities: Mapping[str, str], recording: Recording, env_id: int | None) -> pa.Table:
    """Return a table with units in its fields and, if needed, the environment as a column."""
    fields = []
    for field in table.schema:
        word = _TIME_UNITS.get(field.name) or unit(entities.get(field.name, ""))
        fields.append(field.with_metadata({"unit": word} if word else None))
    columns = list(table.columns)
    if env_id is not None:
        place = sum(name in TIMES for name in table.column_names)
        fields.insert(place, pa.field(ENV, pa.int64()))
        columns.insert(place, pa.array([env_id] * table.num_rows, pa.int64()))
    return pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata={"wheelleg": _about(recording)}))


def _about(recording: Recording) -> str:
    known: dict[str, Any] = {"recording_id": recording.recording_id, "purpose": recording.purpose}
    own = recording.properties.get("wheelleg", {})
    return json.dumps({**known, **{k: own[k] for k in ("run_id", "task", "seed", "step_dt") if k in own}})


def _write_folder(output: Path, tables: Mapping[str, pa.Table], kind: str) -> None:
    with for_people(output), temporary_folder(output) as aside:
        for group, table in tables.items():
            with (aside / f"{_file_name(group)}.{kind}").open("xb") as file:
                file.write(encoded(table, kind))
        if kind == "csv":
            by_group = {group: units(table) for group, table in tables.items()}
            (aside / UNITS_NAME).write_text(json.dumps(by_group, indent=2, ensure_ascii=False) + "\n", "utf-8")
        require_new(output)
        aside.rename(output)


def _exported(path: Path, group: str, table: pa.Table) -> Exported:
    return Exported(path, group, table.num_rows, table.num_columns)
