import json
import re
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
from inspection.synthetic import Writer, drive, late, play, training

from wheelleg_exp.cli.main import main
from wheelleg_exp.recording.rrd_file import RrdFile
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock


def spoil(path, entity=b"base/height"):
    content = bytearray(path.read_bytes())
    places = [(message.begin, message.end) for message in RrdFile(path).messages()]
    begin, end = next(s for s in places if entity in content[s[0] : s[1]] and s[1] - s[0] > 1500)
    content[(begin + end) // 2 : (begin + end) // 2 + 8] = b"XXXXXXXX"
    path.write_bytes(content)


@pytest.fixture
def inspect(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def call(*words):
        status = main(["inspect", *map(str, words)])
        said = capsys.readouterr()
        return status, said.out, said.err

    return call


def test_a_training_starts_with_its_last_sample_and_names_the_rows_of_the_tables(inspect, tmp_path):
    late(tmp_path / "r.rrd")
    out = inspect("r.rrd")[1]
    titles = [block.splitlines()[0] for block in out.split("\n\n")[1:]]
    assert titles[:3] == [
        "training, iteration 15, with exploration",
        "samples of whole episodes, environment 0",
        "below: the last sample with a whole episode, iterations 10 to 11: 40 of 70 recorded frames",
    ]
    assert re.search(r"return, mean +8 +the last 100 ended episodes\n", out)
    assert re.search(r"survived +100.0% \(1 of 1\)\n", out)
    assert "below: 20 of 70 recorded frames\n" in inspect("r.rrd", "--iteration", "0-5")[1]


def test_the_summary_of_a_damaged_recording_is_printed(inspect, tmp_path):
    spoil(play(tmp_path / "r.rrd"))
    status, out, err = inspect("r.rrd")
    assert (status, err) == (0, "")
    assert re.search(r"health +not whole; 1 of \d+ messages are damaged", out)
    assert "feet.left" in out
    assert json.loads(inspect("r.rrd", "--json")[1])["summary"]["health"]["damaged"] == 1


def test_notes_of_the_recording_are_printed(inspect):
    writer = Writer("r.rrd")
    drive(writer)
    writer.words("log/recording", [(1, "the bound of 3 MB is reached", "WARN")])
    writer.numbers("training/Train/mean_reward", [1.0])
    writer.static("spring", stiffness=[1.0])
    writer.close()
    out = inspect("r.rrd")[1]
    assert re.search(r"note +the bound of 3 MB is reached\n", out)
    (holds,) = [line for line in out.splitlines() if line.startswith("contents")]
    assert "rewards" in holds
    assert "spring" not in holds  # The recording has no rows of the spring over time.


def test_the_summary_is_printed_or_one_json_document(inspect, strict_json):
    status, out, err = inspect(play("r.rrd"))
    assert (status, err) == (0, "")
    for words in ("play", "whole", "survived           50.0% (1 of 2)", "drive.v_x", "feet.left", "hip", "push"):
        assert words in out
    status, out, err = inspect("r.rrd", "--json")
    assert (status, err) == (0, "")
    document = strict_json(out)
    assert (document["recording"], document["summary"]["figures"]["survival"]) == ("r.rrd", 0.5)
    assert {"name": "base.pitch", "rows": 200} in json.loads(inspect("r.rrd", "--names", "--json")[1])["names"]
    document = json.loads(inspect(training("t.rrd"), "--env", "5", "--json")[1])
    assert document["summary"]["base"]["height"]["mean"] == pytest.approx(1.1)


def test_times_can_be_pasted_back_as_they_are_printed(inspect):
    writer = Writer("r.rrd")  # A step takes 1/60 s, so the time of step 28 is 0.466666… s and printed as 0.467 s.
    steps = np.arange(1, 61)
    columns = [
        rr.TimeColumn("step", sequence=steps),
        rr.TimeColumn("sim_time", duration=1000 * np.round(steps / 60 * 1e6).astype("timedelta64[ns]")),
    ]
    writer.stream.send_columns("base/height", columns, rr.Scalars.columns(scalars=steps.astype(float)))
    writer.close()

    def extremes(*words):
        stats = json.loads(inspect("r.rrd", "--term", "base.height", *words, "--json")[1])["stats"]["base.height"]
        return stats["minimum"], stats["maximum"]

    assert "0.467 s, step 28" in inspect("r.rrd", "--where", "base.height == 28")[1]
    assert extremes("--from", "0.467s", "--to", "0.467s") == (28, 28)
    assert extremes("--from", "0.016666667s", "--to", "0.016666667s") == (1, 1)
    assert extremes("--from", "28steps", "--to", "500ms") == (28, 30)


def test_units_follow_the_names(inspect):
    assert "contacts.feet.left (N)" in inspect(play("r.rrd"), "--term", "contacts.feet.left")[1]
    words = ("--where", "terminations.fallen", "--around", "1steps", "--term", "base.v_x")
    assert "base.v_x (m/s)" in inspect("r.rrd", *words)[1]
    assert json.loads(inspect("r.rrd", "--term", "base.v_x", "--json")[1])["stats"]["base.v_x"]["unit"] == "m/s"


def test_a_selection_without_rows_is_reported(inspect):
    status, out, _ = inspect(play("r.rrd"), "--from", "100s")
    assert status == 0
    assert re.search(r"below: 0 of 200 recorded frames\n", out)
    assert "0.0%" not in out
    assert re.search(r"alive +3 +- +-\n", out)
    for words in (["--term", "base.pitch"], ["--where", "base.pitch"], ["--export", "csv", "-o", "out"]):
        status, out, err = inspect("r.rrd", "--from", "100s", *words)
        assert (status, out) == (2, "")
        assert "no recorded row is selected; expected times from 0.020 to 4.000 s, steps 1 to 200" in err


def test_statistics_of_terms(inspect):
    status, out, _ = inspect(play("r.rrd"), "--term", "contacts.feet.left", "--stats", "--json")
    stats = json.loads(out)["stats"]["contacts.feet.left"]
    assert (status, stats["mean"], stats["maximum_at"]["step"]) == (0, 100.5, 200)
    term = "--term=contacts.feet.left"
    assert inspect("r.rrd", *term.split("="))[1] == inspect("r.rrd", term, "--stats")[1]
    out = inspect("r.rrd", "--term", "base.pitch", "--from", "1s")[1]
    assert re.search(r"from +1.000 s, step 50\nto +4.000 s, step 200\n", out)


def test_moments_with_the_rows_around(inspect):
    words = ("--where", "terminations.fallen", "--around", "40ms", "--term", "base.pitch")
    status, out, _ = inspect(play("r.rrd"), *words)
    lines = out.splitlines()
    assert (status, lines[0]) == (0, "the condition becomes true once")
    assert [line.split()[:3] for line in lines if line.startswith("*")] == [["*", "50", "1.000"]]
    assert [line.split()[0] for line in lines[4:6]] == ["48", "49"]


def test_two_recordings_compare_with_an_exit_status(inspect):
    play("a.rrd")
    play("b.rrd", recording_id="other")
    writer = Writer("c.rrd")
    drive(writer, offset=1.0)
    writer.close()
    assert inspect("a.rrd", "--compare", "b.rrd")[0] == 0
    status, out, _ = inspect("a.rrd", "--compare", "c.rrd", "--json")
    assert (status, [number["name"] for number in json.loads(out)["compare"]["numbers"]]) == (1, ["base.height"])
    assert "base.height" in inspect("a.rrd", "--compare", "c.rrd")[1]


def test_repair_writes_another_file_and_reports_what_is_lost(inspect, tmp_path):
    path = tmp_path / "r.rrd"
    play(path)
    path.write_bytes(path.read_bytes()[:-2000])
    status, out, _ = inspect("r.rrd", "--repair")
    assert (status, "repaired: r.repaired.rrd" in out, "cut off at byte" in out) == (0, True, True)
    status, _, err = inspect("r.rrd", "--repair")
    assert (status, "exists and is not overwritten" in err) == (2, True)
    assert inspect("r.rrd", "--repair", "-o", "other.rrd")[0] == 0
    assert "whole" in inspect("other.rrd")[1]


@pytest.fixture
def run(tmp_path):
    run = RunDirectory.create(tmp_path / "runs", "stand", 0)
    Manifest.begin(run.path, task="stand", seed=0, command=["wheelleg"], threads={"torch": 1})
    writer = Writer(run.recording)
    drive(writer)
    writer.kill()
    (run.play / "one").mkdir(parents=True)
    play(run.play / "one" / "recording.rrd")
    return run


def test_the_recording_of_a_running_training_is_not_repaired(inspect, run):
    with RunLock(run):
        status, out, err = inspect("latest", "--repair")
    assert (status, out) == (2, "")
    assert "is being written by process" in err
    assert not list(run.path.glob("*.repaired.rrd"))
    assert inspect("latest", "--repair")[0] == 0
    assert re.search(r"\nrun +running\n", inspect("latest")[1])


def test_a_play_is_compared_with_another_run_s_folder(inspect, run, tmp_path):
    for other in (run.play / "one", run.play / "one" / "recording.rrd", "latest"):
        assert inspect("latest", "--play", "--compare", other)[0] == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["absent.rrd"], "there is no file 'absent.rrd'"),
        (["r.rrd", "--term", "base.pitsh"], "did you mean 'base.pitch'"),
        (["r.rrd", "--where", "base.pitch >"], "is not a condition"),
        (["r.rrd", "--where", "base.pitch", "--around", "far"], "not a valid duration"),
        (["r.rrd", "--stats"], "--stats: the name of a recorded number is missing"),
        (["r.rrd", "--env", "9"], "environment 9 was not recorded"),
        (["r.rrd", "--compare", "absent.rrd"], "there is no file 'absent.rrd'"),
        (["r.rrd", "--play"], "is not a run"),
        (["text.rrd"], "is not a Rerun recording"),
        (["gone.rrd"], "'gone.rrd' is a broken symbolic link"),
        (["r.rrd", "--viewer"], "--viewer: the option has no effect on the chosen actions; expected also --screenshot"),
        (["r.rrd", "--at", "1s"], "expected also --screenshot"),
        (["r.rrd", "--fps", "3", "--screenshot", "a.png"], "expected also --video"),
        (["r.rrd", "--width", "3"], "expected also --screenshot or --video"),
        (["r.rrd", "--port", "3"], "expected also --web"),
        (["r.rrd", "--around", "1s"], "expected also --where"),
        (["r.rrd", "-o", "x"],
         "--output: the option has no effect on the chosen actions; expected also --repair or --export"),
        (["r.rrd", "--compare", "r.rrd", "--from", "1s"], "--from: the option has no effect on the chosen actions"),
        (["r.rrd", "--summary", "--term", "base.pitch"], "--stats or --where or --plot or --export"),
        (["r.rrd", "--iteration", "5-2"], "ends before its start"),
        (["r.rrd", "--from", "3s", "--to", "2s"], "the end --to is before the start --from"),
        ([], "RUN|FILE"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_line_and_status_2(inspect, tmp_path, words, said):
    play(tmp_path / "r.rrd")
    (tmp_path / "text.rrd").write_text("not one")
    (tmp_path / "gone.rrd").symlink_to(tmp_path / "nowhere.rrd")
    status, out, err = inspect(*words)
    assert (status, out) == (2, "")
    assert said in err
    assert len(err.splitlines()) == 1


def test_the_contents_of_another_tools_recording_are_listed(inspect):
    writer = Writer("r.rrd", application="another")
    writer.numbers("camera/exposure", [1.0])
    writer.close()
    status, out, _ = inspect("r.rrd")
    assert (status, "wheelleg did not write this recording" in out, "camera" in out) == (0, True, True)


def test_it_needs_neither_torch_nor_mujoco(tmp_path):
    play(tmp_path / "r.rrd")
    code = (
        "import sys; from wheelleg_exp.cli.main import main; status = main(['inspect', sys.argv[1]]);"
        "print(status, [m for m in ('torch', 'mujoco', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "r.rrd"], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "0 []"
