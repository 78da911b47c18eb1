from pathlib import Path

import pytest
from jobs.small import wheelleg
from refused import refusal

pytestmark = pytest.mark.usefixtures("own_folders")

FEW = ["env.num_envs=4", "env.sim.nthread=1"]


def test_the_contact_table_shows_what_each_link_carries():
    said = wheelleg("zero-agent", *FEW, "--steps", "40")
    assert said.status == 0, said.err
    rows = {line.split()[0]: line.split()[1:] for line in said.out.splitlines() if "_link" in line}
    assert len(rows) == 7
    for wheel in ("l_wheel_link", "r_wheel_link"):
        assert float(rows[wheel][0]) == pytest.approx(2.45, rel=0.1)
    assert float(rows["base_link"][0]) == 0.0
    assert "normal force" in said.out


def test_json_is_one_document_and_nothing_else(strict_json):
    document = strict_json(wheelleg("zero-agent", *FEW, "--steps", "3", "--json").out)
    assert (set(document), document["contacts"]) == ({"folder", "contacts", "figures"}, {"contact_forces": []})
    assert (Path(document["folder"]) / "recording.rrd").is_file()


@pytest.mark.parametrize(("steps", "expected"), [("0", "at least 1"), ("-3", "at least 1"), ("many", "--steps")])
def test_a_wrong_number_of_steps_is_refused(steps, expected, tmp_path):
    assert expected in refusal("zero-agent", f"--steps={steps}")
    assert list(tmp_path.iterdir()) == []


def test_the_recording_exists_and_the_run_of_an_agent_is_not_the_latest_run():
    said = wheelleg("random-agent", *FEW, "--steps", "3")
    assert said.status == 0, said.err
    (named,) = [line.split()[-1] for line in said.out.splitlines() if line.startswith("open it:")]
    assert Path(named).is_file()
    assert Path(named).parts[:3] == ("runs", "agents", "stand")
    assert "no run" in refusal("play", "latest")
