import json
import os

import pytest

from foreign.trial import SECRET, VARIABLE, Trial, every_second
from wheelleg_exp.files import write_json
from wheelleg_exp.jobs.train.source_roots import _run_roots

pytestmark = pytest.mark.train

MANIFEST, GIT, LOG = "manifest.json", "source/git.json", "iterations.jsonl"
READERS = ("verify", "report", "inspect", "diff", "play", "resume", "replay")
DIGEST = {"sha256": "0" * 64, "size": 1}


@pytest.fixture
def trial(trial: Trial) -> Trial:
    (trial.run.path / "recording.rrd").unlink()
    trial.yaml(".hydra/config.yaml", lambda config: config["recording"].update(enabled=False))
    return trial


BROKEN = {
    "deep brackets": "[" * 100_000,
    "deep values": '{"format": 1, "a": ' + "[" * 500 + "]" * 500 + "}",
    "a long number": '{"format": ' + "1" * 5000 + "}",
    "a large number": '{"format": ' + "1" * 400 + "}",
    "a list": "[1]",
    "no text": b"\xff\xfe",
    "nothing": "",
}


@pytest.mark.parametrize("content", BROKEN.values(), ids=BROKEN)
def test_a_damaged_manifest_is_refused(trial, content):
    trial.write(MANIFEST, content)
    trial.try_each(READERS, 2, MANIFEST)
    trial.try_("list", 0, "damaged")


def test_a_manifest_without_end_is_not_read(trial):
    with (trial.run.path / MANIFEST).open("wb") as file:
        file.truncate(1 << 40)
    trial.try_("verify", 2, "more than")
    trial.try_("list", 0, "damaged")


KEYS = (
    *("error", "ended", "process", "versions", "hardware", "threads", "environment_variables", "status", "task"),
    *("started", "results", "resumes", "additions", "files", "id", "command", "working_directory", "seeds", "source"),
    *("config_dirs", "config_variables", "replay_of", "recording_unfinished", "format", "sha256", "failure"),
)
VALUES = (None, 7, "x", [], ["x"], [[]], {}, {"x": 1}, True, -1, "inf")
ENTRIES = ({"when": 1}, {"before": 1}, {"overrides": 3}, {"changes": ["x"]}, {"why": "x"}, {"files_to_write": {"a": 1}})


def test_every_key_of_a_manifest_may_hold_anything(trial):
    whole = trial.healthy.manifest().data
    plants = [{key: value} for key in KEYS for value in VALUES]
    plants += [{"results": {"non_finite": value}} for value in VALUES]
    plants += [{key: [entry]} for key in ("resumes", "additions") for entry in (*VALUES, *ENTRIES)]
    for number, plant in enumerate(plants):
        write_json(trial.root / "runs" / "stand" / f"2026-01-01_00-00-00_{number}" / MANIFEST, {**whole, **plant})
    for command in ("list", "json"):
        said = trial.try_(command, 0)
        assert said.out.count("2026-01-01_00-00-00_") >= len(plants)


def test_every_key_of_a_manifest_may_hold_anything_when_it_is_verified(trial):
    trial.try_("verify", 0)
    for key, value in every_second(KEYS, (None, ["x"], {"x": 1}, 7)):
        trial.manifest(**{key: value})
        trial.try_("verify", (0, 1, 2))


NAMES = ["../../../here/precious.yaml", "/etc/hostname", "a/../../b", "a\0b", "..", "a\\..\\b"]


@pytest.mark.parametrize("name", NAMES)
def test_no_name_in_a_manifest_leads_outside(trial, name):
    trial.outside()
    moment = "2026-11-20T10:00:00.000000Z"
    plants = [
        {"files": {name: DIGEST}},
        {"additions": [{"kind": "play", "when": moment, "files": {name: DIGEST}}]},
        {"resumes": [{"when": moment, "files_to_write": {name: "written"}}]},
        {"resumes": [{"when": moment, "before": {"files": {name: DIGEST}}}]},
    ]
    for plant in plants:
        trial.manifest(**plant)
        trial.try_each(("verify", "resume", "play"), 2, MANIFEST, "outside the run directory")
        trial.try_("list", 0, "damaged")


@pytest.mark.parametrize("moment", ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "x", "2026-01-01"])
def test_invalid_times_are_reported(trial, moment):
    for changes in ({"started": moment}, {"ended": moment}):
        trial.manifest(**changes)
        trial.try_each(("list", "json"), 0)
        trial.try_("verify", 2, "is not a UTC time")


PROCESSES = [{"pid": -1}, {"pid": 10**300}, {"pid": "1"}, {"pid": 1, "host": []}, [1]]


@pytest.mark.parametrize("process", PROCESSES, ids=repr)
def test_a_process_may_be_anything(trial, process):
    trial.manifest(status="running", ended=None, process=process)
    trial.try_each(("list", "verify"), (0, 1, 2))


def test_stored_variables_do_not_get_into_this_process(trial, monkeypatch):
    monkeypatch.setenv("PATH", os.environ["PATH"])
    kept = {"PATH": str(trial.run.path), "LD_PRELOAD": "evil.so", "A=B": "c", "": "x", VARIABLE: "theirs"}
    trial.yaml(".hydra/config.yaml", lambda config: config["run"].update(name="${oc.env:PATH}"))
    trial.manifest(config_variables=kept, environment_variables=kept)
    trial.try_each(("diff", "report"), (0, 1))  # The command report also verifies the run.
    assert (os.environ.get("LD_PRELOAD"), os.environ[VARIABLE]) == (None, SECRET)


def test_the_replayed_run_of_a_manifest_is_not_used_as_a_path(trial):
    secret = trial.outside()
    for of in (str(secret.parent), "..", "latest", "../here"):
        trial.manifest(replay_of=of)
        trial.try_("report", 0)


LINES = {
    "deep": b'{"iteration": 3, "digests": {}, "scalars": {"a": ' + b"[" * 100_000 + b"\n",
    "deeper": b'{"iteration": 3, "digests": {}, "scalars": {"a": ' + b"[" * 300 + b"]" * 300 + b"}}\n",
    "numbers": b'{"iteration": 1' + b"0" * 5000 + b"}\n",
    "endless": b'{"iteration": 1e999, "digests": {}, "scalars": {"Perf/collection_time": "x"}}\n',
    "texts": b'{"iteration": 3, "digests": {"parameters": []}, "scalars": {"Train/mean_reward": {"a": []}}}\n',
    "no mapping": b"[]\n7\nnull\n",
}


@pytest.mark.parametrize(("line", "command"), every_second(LINES.values(), ["verify", "compare"]))
def test_a_line_of_the_log_may_be_anything(trial, line, command):
    trial.write(LOG, trial.run.iterations.read_bytes() + line)
    trial.try_("list", 0)
    trial.try_each(("report", command), (0, 1))


RECORDS = [
    {"patch": "../../../here/precious.yaml", "patch_sha256": "0" * 64},
    *({"commit": "--upload-pack=touch ../ran"}, {"tree": "x; touch ../ran"}),
    *({"folders": ["../../.."]}, {"folders": 3}, {"folders": [{}]}),
    *({"others": 7}, {"others": [7]}, {"others": [{"folders": ["/etc"]}]}),
    *({"root": []}, {"refused": ["x"]}, {"submodules": [{}]}, {"format": 2}),
]


@pytest.mark.parametrize(("change", "command"), every_second(RECORDS, ["diff", "verify"]))
def test_a_record_of_the_source_may_hold_anything(trial, change, command):
    trial.outside()
    record = json.loads((trial.run.path / GIT).read_text())
    trial.write(GIT, json.dumps({**record, **change}))
    trial.try_("replay", 2, GIT)
    trial.try_(command, (0, 1, 2) if command == "diff" else (0, 1))


def test_no_repository_that_a_run_names_is_asked_at_a_resume(trial):
    for place in (trial.run.path / "evil", trial.root / "here" / "theirs"):
        place.mkdir()
        record = json.loads((trial.run.path / GIT).read_text())
        named = [{**record, "root": str(place), "folders": ["."], "others": []} for _ in range(2)]
        trial.write(GIT, json.dumps({**named[0], "others": named[1:]}))
        assert place not in _run_roots(trial.run, [])
