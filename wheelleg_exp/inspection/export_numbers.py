"""Export the numbers of a recording for other tools: Parquet with units, or CSV."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import for_people, require_new, temporary_folder, write_new
from wheelleg_exp.inspection.recorded_numbers import find_number, frames_for, is_of_env
from wheelleg_exp.inspection.row_selection import Selection, nothing_chosen
from wheelleg_exp.recording.layout import ITERATION, SIM_TIME, STEP, unit
from wheelleg_exp.recording.reading.arrow_values import TIMELINES
from wheelleg_exp.recording.reading.recording_reader import Recording

KINDS = ("parquet", "csv")
ENV = "env"
UNITS_NAME = "units.json"
_LONGEST_NAME = 100
_TIME_UNITS = {STEP: "control steps", SIM_TIME: "s", ITERATION: "iterations"}


@dataclass(frozen=True)
class Exported:
    """A written file: its path, its group of numbers, and its numbers of rows and columns."""

    path: Path
    group: str
    rows: int
    columns: int


def export(
    recording: Recording, kind: str, output: Path, *, terms: Sequence[str] = (), selection: Selection | None = None
) -> list[Exported]:
    """Write the numbers of a recording: a folder with one file per group, or one file of selected numbers.

    Every table has the columns ``step``, ``sim_time`` (s), ``iteration`` for a training, and ``env`` for several
    environments; numbers are float64 columns. Parquet files store the unit in the field's metadata (``unit``), and the
    recording's properties in the schema's (``wheelleg``); a folder of CSV files has the units in ``units.json``. In
    CSV, NaN is ``nan``, and an empty field means that a number was not recorded at the row's step.

    If ``terms`` lists numbers such as ``rewards.base_height``, one file with only these is written. ``output`` must not
    exist, and appears only when its content is complete.
    """
    if kind not in KINDS:
        raise WheellegError(f"'{kind}' is not a supported export format", key="--export", expected=" or ".join(KINDS))
    require_new(output)
    chosen = selection or Selection()
    if terms:
        tables = []
        for frames in frames_for(recording, terms, chosen):
            entities = {term: find_number(recording, term, frames.env_id).entity for term in terms}
            env_id = frames.env_id if len(recording.env_ids) > 1 else None
            tables.append(_described(frames.table, entities, recording, env_id))
        table = pa.concat_tables(tables, promote_options="default")
        if not len(table) and not chosen.is_all:
            raise nothing_chosen(recording)
        write_new(output, encoded(table, kind))
        return [Exported(output, "terms", *table.shape)]
    groups = {name.split(".")[0]: None for env_id in recording.env_ids for name in recording.all_numbers(env_id)}
    of_groups = {group: table for group in groups if (table := _of_group(recording, group, chosen)).num_rows}
    if not of_groups:
        raise nothing_chosen(recording)
    with for_people(output), temporary_folder(output) as aside:
        for group, table in of_groups.items():
            with (aside / f"{_file_name(group)}.{kind}").open("xb") as file:
                file.write(encoded(table, kind))
        if kind == "csv":
            by_group = {group: units(table) for group, table in of_groups.items()}
            (aside / UNITS_NAME).write_text(json.dumps(by_group, indent=2, ensure_ascii=False) + "\n", "utf-8")
        require_new(output)
        aside.rename(output)
    return [Exported(output / f"{_file_name(name)}.{kind}", name, *table.shape) for name, table in of_groups.items()]


def encoded(table: pa.Table, kind: str) -> bytes:
    """Return the content of a CSV or Parquet file with the given table."""
    buffer = io.BytesIO()
    if kind == "parquet":
        pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
    else:
        pacsv.write_csv(table, buffer)
    return buffer.getvalue()


def units(table: pa.Table) -> dict[str, str]:
    """Return the unit of each table column that has a unit, by the column's name."""
    found = {field.name: (field.metadata or {}).get(b"unit") for field in table.schema}
    return {name: value.decode() for name, value in found.items() if value}


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
        if not is_own:  # Export numbers that all environments share, such as training scalars, only once.
            break
    return pa.concat_tables(tables, promote_options="default") if tables else pa.table({})


def _file_name(group: str) -> str:
    # Encode characters such as '/', because the name of a group of recorded numbers becomes a file name.
    return re.sub(r"[^\w-]", lambda found: f"%{ord(found.group()):02x}", group)[:_LONGEST_NAME] or "%"


def _within(group: str, name: str) -> str:
    short = name.removeprefix(f"{group}.")
    return name if short in (*TIMELINES, ENV) else short


def _described(table: pa.Table, entities: Mapping[str, str], recording: Recording, env_id: int | None) -> pa.Table:
    words = [_TIME_UNITS.get(name) or unit(entities.get(name, "")) for name in table.column_names]
    fields = [f.with_metadata({"unit": w} if w else None) for f, w in zip(table.schema, words, strict=True)]
    columns = list(table.columns)
    if env_id is not None:
        place = sum(name in TIMELINES for name in table.column_names)
        fields.insert(place, pa.field(ENV, pa.int64()))
        columns.insert(place, pa.array([env_id] * table.num_rows, pa.int64()))
    own = recording.properties.get("wheelleg", {})
    about = {key: own[key] for key in ("run_id", "task", "seed", "step_dt") if key in own}
    about = {"recording_id": recording.recording_id, "purpose": recording.purpose, **about}
    return pa.Table.from_arrays(columns, schema=pa.schema(fields, metadata={"wheelleg": json.dumps(about)}))
