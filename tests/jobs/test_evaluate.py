"""``wheelleg evaluate RUN``: what it keeps below the run, and that it can be verified."""

from __future__ import annotations

import csv
import json

import pytest

from wheelleg_exp.cli.main import main

pytestmark = pytest.mark.train

SHORT = ("protocol.stand.episodes=3", "protocol.stand.horizon_s=1.5", "protocol.stand.survival_s=[0.5]")


def test_an_evaluation_is_kept_recorded_and_verified(run, capsys):
    assert main(["evaluate", str(run.path), *SHORT, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    (folder,) = run.evaluation.iterdir()
    kept = json.loads((folder / "evaluation.json").read_text())
    with (folder / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    mean = sum(float(row["time_to_failure_s"]) for row in rows) / 3
    assert kept["metrics"]["stand/time_to_failure"]["value"] == pytest.approx(mean)
    assert kept["metrics"] == said["metrics"]
    assert [row["ended_by"] for row in rows].count("") == 3 - sum(row["survived"] == "0" for row in rows)
    entry = run.manifest().data["additions"][-1]
    assert (entry["kind"], entry["results"]["scenarios_sha256"]) == ("evaluation", kept["scenarios_sha256"])
    assert main(["verify", str(run.path)]) == 0
    (folder / "evaluation.json").write_text(json.dumps({**kept, "seed": 1}))
    capsys.readouterr()
    assert main(["verify", str(run.path)]) == 1
    assert "evaluation.json" in capsys.readouterr().out


def test_a_protocol_that_is_not_there_is_told_with_the_nearest(run, capsys):
    assert main(["evaluate", str(run.path), "protocol=stnd"]) == 2
    assert "stand" in capsys.readouterr().err


def test_another_robot_is_refused(run, capsys):
    assert main(["evaluate", str(run.path), "env.robot.asset=other.usd"]) == 2
    assert "env.robot.asset" in capsys.readouterr().err
