"""``wheelleg evaluate`` on several runs, against another and beside the reference: what it prints, keeps, takes up."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.evaluation.method_comparison import over_seeds
from wheelleg_exp.jobs.evaluate_policy import RESULT, read_content, read_evaluation

pytestmark = pytest.mark.train

SHORT = (
    "protocol.stand.episodes=4",
    "protocol.stand.horizon_s=1.5",
    "protocol.stand.survival_s=[0.5,1.5]",
    "protocol.resamples=50",
)


def evaluated(capsys, *words) -> dict:
    assert main(["evaluate", *map(str, words), *SHORT, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_kept_evaluation_is_read_back_as_it_was(run, capsys):
    content = evaluated(capsys, run.path)
    (folder,) = [path.parent for path in run.evaluation.glob(f"*/{RESULT}")]
    found = read_evaluation(folder)
    assert json.loads(json.dumps(found.as_dict())) == {key: content[key] for key in found.as_dict()}
    assert found.episodes["test"].tolist() == ["stand"] * 4
    assert np.isfinite(found.episodes["time_to_failure_s"]).all()


def test_a_run_beside_a_copy_and_the_reference(run, capsys, tmp_path):
    other = shutil.copytree(run.path, tmp_path / "other")
    found = evaluated(capsys, run.path, "--against", other, "--reference")
    assert len(found["evaluations"]) == 3
    assert found["verdict"].startswith("No difference between")
    assert {row["interval"]["value"] for row in found["differences"].values()} <= {0.0, None}
    assert read_content(Path(found["evaluations"][2]))["policy"] == "reference"
    kinds = [entry["kind"] for entry in run.manifest().data["additions"]]
    assert kinds == ["evaluation", "reference", "comparison"]
    again = evaluated(capsys, run.path, "--against", "reference", "--kept")
    assert again["evaluations"][0] == found["evaluations"][0]  # taken, not made anew
    assert again["differences"]["stand/survival"]["second"] == 1.0
    assert again["differences"]["stand/survival"]["test"]["test"] == "McNemar"


def test_several_runs_are_told_in_one_table(run, capsys, tmp_path):
    assert main(["evaluate", str(run.path), str(shutil.copytree(run.path, tmp_path / "other")), *SHORT]) == 0
    out = capsys.readouterr().out
    assert [word for word in ("run 1: ", "run 2: other") if word not in out] == []
    survival = next(line for line in out.splitlines() if line.startswith("stand/survival "))
    assert survival.split()[1:3] == ["0", "0"]


@pytest.mark.parametrize("words", [["--against", "nosuch"], ["nosuch"], ["--checkpoint", "77"]])
def test_a_run_or_checkpoint_that_is_not_there_is_told_before_any_is_evaluated(run, capsys, words):
    assert main(["evaluate", str(run.path), *words, *SHORT]) == 2
    assert words[-1] in capsys.readouterr().err
    assert not run.evaluation.exists()


def test_one_training_named_twice_is_no_two_seeds(run, capsys):
    assert main(["evaluate", str(run.path), str(run.path), *SHORT]) == 2
    assert "is named twice" in capsys.readouterr().err


def test_what_is_kept_is_found_in_whatever_words_its_protocol_was_asked_for(run, capsys):
    first = evaluated(capsys, run.path)
    again = evaluated(capsys, run.path, "protocol=stand", "protocol.stand.episodes=4", "--kept")
    assert again["folder"] == first["folder"]
    other = evaluated(capsys, run.path, "seed=7", "--kept")
    assert other["folder"] != first["folder"]
    finer = evaluated(capsys, run.path, "env.sim.dt=0.004", "--kept")
    assert finer["folder"] not in (first["folder"], other["folder"])


def test_metrics_that_no_episode_tells_of_take_one_line(run, capsys):
    assert main(["evaluate", str(run.path), *SHORT]) == 0
    alone = capsys.readouterr().out
    assert main(["evaluate", str(run.path), "--against", "reference", "--kept", *SHORT]) == 0
    beside = capsys.readouterr().out
    assert "no episode has a value for: drift, " in alone
    assert "no episode has a value for: stand/cost_of_transport_gross, " in beside
    assert not [line for line in alone.splitlines() if line.split()[:3:2] == ["drift", "-"]]


def test_runs_of_other_scenarios_are_refused(run, capsys):
    evaluated(capsys, run.path)
    main(["evaluate", str(run.path), *SHORT, "protocol.stand.episodes=5"])
    capsys.readouterr()
    folders = sorted(path.parent for path in run.evaluation.glob(f"*/{RESULT}"))
    with pytest.raises(RunDirectoryError, match="different scenarios"):
        over_seeds([read_evaluation(folder) for folder in folders])


def test_a_damaged_evaluation_is_said_to_be_so(run, capsys):
    evaluated(capsys, run.path)
    (path,) = run.evaluation.glob(f"*/{RESULT}")
    path.write_text("{")
    with pytest.raises(RunDirectoryError, match="is damaged"):
        read_evaluation(path.parent)
