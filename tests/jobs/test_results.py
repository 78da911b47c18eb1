"""Tables of results: what they hold, and that they come out again to the bit; what does not is told."""

from __future__ import annotations

import json

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import write_json
from wheelleg_exp.jobs.results.record import read_record, recipe

pytestmark = pytest.mark.train

SHORT = ("protocol.stand.episodes=3", "protocol.stand.horizon_s=1.1", "protocol.stand.survival_s=[0.5]")


@pytest.fixture
def written(run, tmp_path, capsys):
    """The folder of a result of one run beside the reference."""
    folder = tmp_path / "results"
    words = ["results", "small", str(run.path), *SHORT, "protocol.resamples=50", "--reference", "--into", str(folder)]
    assert main(words) == 0
    capsys.readouterr()
    return folder


def test_a_result_comes_out_again_to_the_bit_and_what_was_changed_is_told(written, capsys):
    """Then one digit of one number is changed, as a result of another program would be."""
    assert main(["results", "small", "--again", "--into", str(written)]) == 0
    assert capsys.readouterr().out.endswith("small: reproduced to the bit\n")
    record = read_record(written / "small.json")
    record["reference"]["metrics"]["stand/time_to_failure"]["value"] *= 1 + 1e-12
    record["runs"] = record["runs"][:1]
    write_json(written / "small.json", record)
    assert main(["results", "small", "--again", "--into", str(written)]) == 1
    told = capsys.readouterr().out
    assert "reference: stand/time_to_failure is" in told
    assert "run 1: stand" not in told
    assert told.endswith("small: not reproduced to the bit\n")


def test_the_page_has_the_numbers_the_commands_and_the_manifests(run, written):
    page, record = (written / "small.md").read_text(), json.loads((written / "small.json").read_text())
    assert f"scenarios `{record['scenarios_sha256'][:16]}`" in page
    assert "| survival |" in page
    assert "\nwheelleg train env.num_envs=16 " in page
    manifest = json.loads((written / "small" / f"{run.id}.json").read_text())
    assert manifest["files"]["model_2.pt"] == run.manifest().data["files"]["model_2.pt"]
    everything = page + json.dumps(record) + json.dumps(manifest)
    assert str(run.path.parent) not in everything  # nothing of where it lay


def test_a_run_that_was_resumed_exactly_to_go_on_for_longer_is_one_training_of_that_length(run):
    data = json.loads((run.path / "manifest.json").read_text())
    longer = {"exact": True, "overrides": ["agent.max_iterations=9"]}
    write_json(run.path / "manifest.json", {**data, "resumes": [{"exact": True, "overrides": []}, longer]})
    lengths = [word for word in recipe(run)["overrides"] if word.startswith("agent.max_iterations")]
    assert lengths == ["agent.max_iterations=9"]
    for other in ({"exact": False, "overrides": []}, {"exact": True, "overrides": ["agent.algorithm.gamma=0.9"]}):
        write_json(run.path / "manifest.json", {**data, "resumes": [other]})
        with pytest.raises(RunDirectoryError, match="in one go"):
            recipe(run)


def test_a_run_that_was_not_trained_in_one_go_is_no_result(run):
    data = json.loads((run.path / "manifest.json").read_text())
    write_json(run.path / "manifest.json", {**data, "status": "interrupted"})
    with pytest.raises(RunDirectoryError, match="in one go"):
        recipe(run)


@pytest.mark.parametrize("name", ["../outside", "a/b", "", ".."])
def test_a_page_has_no_path_for_a_name(run, capsys, tmp_path, name):
    assert main(["results", name, str(run.path), *SHORT, "--into", str(tmp_path / "results")]) == 2
    assert "is no name of a page" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.md"))
