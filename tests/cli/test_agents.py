from __future__ import annotations

import json
from pathlib import Path

import pytest
from jobs.small import cache_of, wheelleg

FEW = ["env.num_envs=4", "env.sim.nthread=1"]


@pytest.fixture(autouse=True)
def _own_folders(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))


def test_the_contact_table_shows_what_each_link_carries():
    said = wheelleg("zero-agent", *FEW, "--steps", "40")
    assert said.status == 0, said.err
    rows = {line.split()[0]: line.split()[1:] for line in said.out.splitlines() if "_link" in line}
    assert len(rows) == 7
    for wheel in ("l_wheel_link", "r_wheel_link"):
        assert float(rows[wheel][0]) == pytest.approx(2.45, rel=0.1)
    assert float(rows["base_link"][0]) == 0.0
    assert "normal force" in said.out


def test_json_is_one_document_and_nothing_else():

    def refuse(word):
        raise AssertionError(f"{word} is no JSON")

    said = wheelleg("zero-agent", *FEW, "--steps", "3", "--json")
    document = json.loads(said.out, parse_constant=refuse)
    assert set(document) == {"folder", "contacts", "figures"}
    assert document["contacts"] == {"contact_forces": []}
    assert (Path(document["folder"]) / "recording.rrd").is_file()


@pytest.mark.parametrize(("word", "told"), [("0", "at least 1"), ("-3", "at least 1"), ("many", "--steps")])
def test_a_wrong_number_of_steps_is_told(word, told, tmp_path):
    said = wheelleg("zero-agent", f"--steps={word}")
    assert said.status == 2
    assert told in said.err
    assert len(said.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_the_recording_exists_and_the_run_of_an_agent_is_not_the_latest_run():
    said = wheelleg("random-agent", *FEW, "--steps", "3")
    assert said.status == 0, said.err
    (named,) = [line.split()[-1] for line in said.out.splitlines() if line.startswith("open it:")]
    assert Path(named).is_file()
    assert Path(named).parts[:3] == ("runs", "agents", "stand")
    said = wheelleg("play", "latest")
    assert said.status == 2
    assert "no run" in said.err
