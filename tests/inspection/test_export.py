import csv
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from inspection.written import DT, ITERATIONS, STEPS, numbers, scalar_values, steps_of

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.export_numbers import encoded, export, units
from wheelleg_exp.inspection.row_selection import Length, Selection
from wheelleg_exp.recording.reading.recording_reader import Recording

GROUPS = {"base", "commands", "contacts", "joints", "rewards", "terminations"}


def read_csv(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    return {name: np.array([float(row[i]) for row in rows]) for i, name in enumerate(header)}


def test_a_folder_has_one_parquet_file_a_group_with_units_and_origin(played: Recording, tmp_path: Path) -> None:
    told, out = export(played, "parquet", tmp_path / "out"), tmp_path / "out"
    assert {path.stem for path in out.glob("*.parquet")} == GROUPS == {entry.group for entry in told}
    table = pq.read_table(out / "base.parquet")
    assert table.column("step").to_pylist() == list(range(1, STEPS + 1))
    np.testing.assert_allclose(table.column("sim_time"), np.arange(1, STEPS + 1) * DT, atol=1e-9)
    np.testing.assert_array_equal(table.column("pitch"), numbers(steps_of(training=False))["base/pitch"])
    assert all(entry.rows == STEPS for entry in told)
    found = units(table)
    assert {name: found[name] for name in ("sim_time", "height", "pitch", "v_x", "w_z")} == {
        "sim_time": "s", "height": "m", "pitch": "rad", "v_x": "m/s", "w_z": "rad/s",
    }  # fmt: skip
    found = units(pq.read_table(tmp_path / "out" / "joints.parquet"))
    assert (found["knee.effort"], found["knee.position"], found["roll.velocity"]) == ("N·m", "rad", "rad/s")
    about = json.loads(pq.read_schema(tmp_path / "out" / "rewards.parquet").metadata[b"wheelleg"])
    assert about == {"recording_id": "played", "purpose": "play", "step_dt": DT}


def test_csv_has_the_same_bits_and_a_file_of_units(played: Recording, tmp_path: Path) -> None:
    export(played, "csv", tmp_path / "out")
    expected = numbers(steps_of(training=False))
    found = read_csv(tmp_path / "out" / "rewards.csv")
    np.testing.assert_array_equal(found["effort"], expected["rewards/effort"])
    np.testing.assert_array_equal(read_csv(tmp_path / "out" / "base.csv")["w_z"], expected["base/w_z"])
    told = json.loads((tmp_path / "out" / "units.json").read_text())
    assert told["rewards"]["effort"] == "1/s"


def test_csv_writes_every_kind_of_float_so_that_it_comes_back(tmp_path: Path) -> None:
    values = np.array([0.1, 1 / 3, 1e-300, -0.0, 5e-324, 1.7976931348623157e308, np.inf, -np.inf, np.nan])
    values = np.concatenate((values, np.random.default_rng(1).integers(0, 2**63, 2000).view(np.float64)))
    path = tmp_path / "x.csv"
    path.write_bytes(encoded(pa.table({"x": values}), "csv"))
    found = read_csv(path)["x"]
    finite = ~np.isnan(values)
    assert found[finite].tobytes() == values[finite].tobytes()
    assert np.isnan(found[~finite]).all()


def test_chosen_terms_make_one_file(played: Recording, tmp_path: Path) -> None:
    path = tmp_path / "sub" / "two.csv"
    told = export(played, "csv", path, terms=["rewards.effort", "base/height"])
    found = read_csv(path)
    assert list(found) == ["step", "sim_time", "rewards.effort", "base/height"]
    np.testing.assert_array_equal(found["base/height"], numbers(steps_of(training=False))["base/height"])
    assert [(entry.path, entry.rows, entry.columns) for entry in told] == [(path, STEPS, 4)]


def test_a_training_has_iterations_and_its_scalars(trained: Recording, tmp_path: Path) -> None:
    export(trained, "parquet", tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "training.parquet")
    assert table.column("iteration").to_pylist() == list(range(ITERATIONS))
    np.testing.assert_array_equal(table.column("Loss.value"), scalar_values()["Loss/value"])
    rows = pq.read_table(tmp_path / "out" / "rewards.parquet").column("iteration").to_pylist()
    assert sorted(set(rows)) == [0, 1, 2, 5, 6, 7, 10, 11, 12]


def test_several_environments_stand_in_one_table(several: Recording, tmp_path: Path) -> None:
    export(several, "parquet", tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "base.parquet")
    assert table.column("env").to_pylist() == [0] * STEPS + [3] * STEPS
    height = np.asarray(table.column("height"))
    np.testing.assert_allclose(height[STEPS:] - height[:STEPS], 0.001)
    assert units(table)["height"] == "m"
    chosen = Selection(env_id=3, begin=Length(0.2, False), end=Length(0.4, False))
    export(several, "parquet", tmp_path / "chosen", selection=chosen)
    table = pq.read_table(tmp_path / "chosen" / "rewards.parquet")
    assert table.column("step").to_pylist() == list(range(10, 21))
    assert set(table.column("env").to_pylist()) == {3}


def test_a_folder_appears_whole_or_not_at_all(played: Recording, tmp_path: Path, monkeypatch) -> None:
    from wheelleg_exp.inspection import export_numbers as module

    written = []

    def fails(table: pa.Table, kind: str) -> bytes:
        written.append(table)
        if len(written) == 3:
            raise OSError(28, "No space left on device")
        return encoded(table, kind)

    monkeypatch.setattr(module, "encoded", fails)
    with pytest.raises(WheellegError, match="no space left"):
        export(played, "csv", tmp_path / "out")
    assert not list(tmp_path.iterdir())
