import json
from pathlib import Path

import pytest
from jobs.small import ITERATIONS, SMALL, wheelleg

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("own_folders")]


def test_the_last_lines_name_the_run_and_the_next_commands(trained):
    path = str(trained.run.path)
    lines = trained.said.out.splitlines()
    assert lines[0].startswith(f"trained {ITERATIONS} iterations in ")
    assert lines[0].endswith(path)
    assert f"wheelleg play {path}" in lines[1]
    assert "tensorboard --logdir" in trained.said.out
    assert any(line.endswith("recording.rrd") for line in lines)


def test_progress_tables_and_warnings_go_to_standard_error(trained):
    assert "run directory: " in trained.said.err
    for word in ("Robot", "Observations 'policy': (135,)", "Rewards: 17", "alive"):
        assert word in trained.said.err
        assert word not in trained.said.out
    said = " ".join(trained.said.err.split())
    # An episode of 0.3 s is shorter than three time constants of the robot's fall.
    assert "warning: env.episode_length_s: an episode of 0.3 s holds 2.8 time constants of the fall" in said
    assert "check.silence.episode_end silences it" in said


def test_json_is_one_document_and_the_run_is_below_the_working_folder_by_default(tmp_path):
    said = wheelleg("train", "--json", *SMALL, "agent.max_iterations=1", "recording.enabled=false")
    assert said.status == 0, said.err
    document = json.loads(said.out)
    assert set(document) == {"run", "status", "results"}
    assert (document["status"], document["results"]["iterations"]) == ("finished", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    (run,) = (tmp_path / "runs" / "stand").iterdir()
    assert Path(document["run"]) == run
    assert (run / "manifest.json").is_file()
    assert not list(run.rglob("*.rrd"))
