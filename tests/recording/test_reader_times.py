import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from inspection.synthetic import Writer

from wheelleg_exp.cli.main import main
from wheelleg_exp.inspection.recording_summary import summarize
from wheelleg_exp.recording.reading.arrow_values import python_values
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording

NS = [1, 1_000_000_001, 2_000_000_002]


@pytest.fixture
def path(tmp_path):
    writer = Writer(tmp_path / "r.rrd")
    times = [
        rr.TimeColumn("step", sequence=[1, 2, 3]),
        rr.TimeColumn("sim_time", duration=np.array(NS, "timedelta64[ns]")),
        rr.TimeColumn("when", timestamp=np.array([1, 2, 2**63 - 1], "datetime64[ns]")),
    ]
    columns = [*rr.TextLog.columns(text=["push", "fell", "end"], level=["INFO", "WARN", "INFO"])]
    writer.stream.send_columns("log/episodes", times, columns)
    writer.stream.send_columns("base/height", times, rr.Scalars.columns(scalars=[1.0, 2.0, 3.0]))
    writer.static("__properties/wheelleg", made=np.array([7], "datetime64[ns]"), took=np.array([9], "timedelta64[ns]"))
    writer.static("documents/a", made=np.array([7], "datetime64[ns]"))
    return writer.close()


def test_events_and_properties_have_their_times_to_the_nanosecond(path):
    recording = Recording(path)
    events = recording.events()
    assert [event.time_s for event in events] == [value * 1e-9 for value in NS]
    expected = [(1, "push", "INFO"), (2, "fell", "WARN"), (3, "end", "INFO")]
    assert [(event.step, event.text, event.level) for event in events] == expected
    assert recording.properties["wheelleg"] == {"made": 7, "took": 9}
    assert summarize(recording).properties["wheelleg"]["made"] == 7
    assert {"base/height", "documents/a", "log/episodes"} <= entity_digests(path, without=()).keys()


def test_every_action_that_prints_reads_them(path, capsys):
    for words in ([], ["--json"], ["--names"], ["--stats", "--term", "base.height"], ["--where", "base.height > 1"]):
        assert main(["inspect", str(path), *words]) == 0, capsys.readouterr().err
    assert main(["inspect", str(path), "--compare", str(path)]) == 0


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (pa.duration("ns"), [1, None, 2**63 - 1]),
        (pa.timestamp("ns", tz="UTC"), [1, -(2**63)]),
        (pa.timestamp("s"), [2**62]),
        (pa.time64("ns"), [1]),
        (pa.date32(), [2**31 - 1]),
        (pa.list_(pa.duration("ns")), [[1, 2], None]),
        (pa.large_list(pa.duration("ns")), [[1], []]),
        (pa.list_(pa.timestamp("ns"), 2), [[1, 2]]),
        (pa.struct([("at", pa.timestamp("ns"))]), [{"at": 1}, None]),
        (pa.list_(pa.string()), [["a"], None]),
        (pa.float64(), [1.5]),
    ],
    ids=str,
)
def test_every_kind_of_time_becomes_a_number(kind, values):
    assert python_values(pa.array(values, kind)) == values
    assert python_values(pa.chunked_array([pa.array(values, kind)])) == values
