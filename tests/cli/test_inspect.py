"""``wheelleg inspect``: what is printed, the JSON document, the exit status."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from inspection.synthetic import Writer, drive, play, training

from wheelleg_exp.cli.main import main


@pytest.fixture
def inspect(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*words):
        status = main(["inspect", *map(str, words)])
        said = capsys.readouterr()
        return status, said.out, said.err

    return call


def refuse(word):
    raise AssertionError(f"{word} is no JSON")


def test_the_summary_is_printed(inspect):
    status, out, err = inspect(play("r.rrd"))
    assert (status, err) == (0, "")
    for words in ("play", "whole", "survived to the time-out       50.0%", "drive.v_x", "feet.left", "hip", "push"):
        assert words in out


def test_json_is_one_document(inspect):
    status, out, err = inspect(play("r.rrd"), "--json")
    document = json.loads(out, parse_constant=refuse)
    assert (status, err) == (0, "")
    assert document["recording"] == "r.rrd"
    assert document["summary"]["figures"]["survival"] == 0.5


def test_statistics_of_terms(inspect):
    status, out, _ = inspect(play("r.rrd"), "--term", "contacts.feet.left", "--stats", "--json")
    stats = json.loads(out)["stats"]["contacts.feet.left"]
    assert status == 0
    assert (stats["mean"], stats["maximum_at"]["step"]) == (100.5, 200)
    assert (
        inspect("r.rrd", "--term", "contacts.feet.left")[1]
        == inspect("r.rrd", "--term=contacts.feet.left", "--stats")[1]
    )


def test_moments_with_the_rows_around(inspect):
    status, out, _ = inspect(
        play("r.rrd"), "--where", "terminations.fallen", "--around", "40ms", "--term", "base.pitch"
    )
    assert status == 0
    assert out.splitlines()[0] == "it holds once"
    marked = [line.split() for line in out.splitlines() if line.startswith("*")]
    assert [line[:3] for line in marked] == [["*", "50", "1.000"]]
    assert [line.split()[0] for line in out.splitlines()[4:6]] == ["48", "49"]


def test_two_recordings_compare_with_an_exit_status(inspect):
    play("a.rrd")
    play("b.rrd", recording_id="other")
    writer = Writer("c.rrd")
    drive(writer, offset=1.0)
    writer.close()
    assert inspect("a.rrd", "--compare", "b.rrd")[0] == 0
    status, out, _ = inspect("a.rrd", "--compare", "c.rrd", "--json")
    assert status == 1
    assert [number["name"] for number in json.loads(out)["compare"]["numbers"]] == ["base.height"]
    assert "base.height" in inspect("a.rrd", "--compare", "c.rrd")[1]


def test_repair_writes_beside_and_tells_what_is_lost(inspect, tmp_path):
    path = tmp_path / "r.rrd"
    play(path)
    path.write_bytes(path.read_bytes()[:-2000])
    status, out, _ = inspect("r.rrd", "--repair")
    assert status == 0
    assert "mended: r.repaired.rrd" in out
    assert "cut off at byte" in out
    status, _, err = inspect("r.rrd", "--repair")
    assert status == 2
    assert "exists and is not overwritten" in err
    assert inspect("r.rrd", "--repair", "-o", "other.rrd")[0] == 0
    assert "whole" in inspect("other.rrd")[1]


def test_names_are_listed(inspect):
    status, out, _ = inspect(play("r.rrd"), "--names", "--json")
    assert status == 0
    assert {"name": "base.pitch", "rows": 200} in json.loads(out)["names"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["absent.rrd"], "there is no file 'absent.rrd'"),
        (["r.rrd", "--term", "base.pitsh"], "did you mean 'base.pitch'"),
        (["r.rrd", "--where", "base.pitch >"], "is no condition"),
        (["r.rrd", "--where", "base.pitch", "--around", "far"], "no length of time"),
        (["r.rrd", "--stats"], "--stats: it is not said of what"),
        (["r.rrd", "--env", "9"], "environment 9 was not recorded"),
        (["r.rrd", "--compare", "absent.rrd"], "there is no file 'absent.rrd'"),
        (["r.rrd", "--play"], "is no run"),
        (["text.rrd"], "no rerun recording"),
        ([], "RUN|FILE"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(inspect, tmp_path, words, said):
    play(tmp_path / "r.rrd")
    (tmp_path / "text.rrd").write_text("not one")
    status, out, err = inspect(*words)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


def test_a_recording_of_another_tool_tells_what_it_holds(inspect):
    writer = Writer("r.rrd", application="another")
    writer.numbers("camera/exposure", [1.0])
    writer.close()
    status, out, _ = inspect("r.rrd")
    assert status == 0
    assert "not recorded by wheelleg" in out
    assert "camera" in out


def test_environments_of_a_training(inspect):
    status, out, _ = inspect(training("r.rrd"), "--env", "5", "--json")
    assert status == 0
    assert json.loads(out)["summary"]["base"]["height"]["mean"] == pytest.approx(1.1)


def test_it_needs_neither_torch_nor_mujoco_nor_rerun(tmp_path):
    play(tmp_path / "r.rrd")
    code = (
        "import sys; from wheelleg_exp.cli.main import main; status = main(['inspect', sys.argv[1]]);"
        "print(status, [m for m in ('torch', 'mujoco', 'rerun', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "r.rrd"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 []"
