import json
import shutil

import pytest
from jobs.small import ITERATIONS, copied

from wheelleg_exp.files import write_text
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.train


@pytest.fixture
def run(trained, root) -> RunDirectory:
    return copied(trained, root.parent)


def _repeat(run: RunDirectory, folder, change=None, **facts) -> RunDirectory:
    shutil.copytree(run.path, folder)
    (folder / "manifest.json").unlink()
    log = folder / "iterations.jsonl"
    if change is not None:
        lines = [json.loads(line) for line in log.read_text().splitlines()]
        change(lines)
        write_text(log, "".join(json.dumps(line) + "\n" for line in lines))
    old = run.manifest().data
    manifest = Manifest.begin(folder, task="stand", seed=0, command=["wheelleg"], threads=old["threads"])
    manifest.record(**facts)
    manifest.record(source=old["source"], files=inventory(folder))
    manifest.finish("finished", old["results"])
    return RunDirectory(folder)


def test_an_unchanged_run_names_the_replay_that_proves_it_and_an_equal_replay_proves_it(page, run, root):
    found = page(run)
    assert "Reproducibility Untested" in found.text
    text = found.section("trust")
    assert "The run is what its manifest says" in text
    assert f"wheelleg replay {run.id}" in text
    _repeat(run, root / "replays" / "stand" / "again", replay_of=run.id)
    found = page(run)
    assert "Reproducibility Proven 1 repeated run, equal to the bit" in found.text
    assert f"stand/again replay identical {ITERATIONS} iterations" in found.section("trust")


def test_one_run_with_other_numbers_refutes_it(page, run, root):
    def change(lines):
        lines[1]["digests"]["parameters"] = "f" * 16
        lines[1]["scalars"]["Train/mean_reward"] += 1.0

    _repeat(run, root / "replays" / "stand" / "again", replay_of=run.id)
    _repeat(run, root / "replays" / "stand" / "unlike", change, replay_of=run.id)
    found = page(run)
    assert "Reproducibility Refuted stand/unlike gave other numbers" in found.text
    assert "different" in found.section("trust")


def test_a_repeat_that_is_damaged_refutes_nothing(page, run, root):
    repeat = _repeat(run, root / "replays" / "stand" / "again", replay_of=run.id)
    repeat.latest_checkpoint().unlink()
    found = page(run)
    assert "Reproducibility Untested" in found.text
    assert "not compared" in found.section("trust")
    assert "damaged: B: model_2.pt is missing" in found.section("trust")


def test_a_run_of_the_same_settings_counts_and_one_of_other_settings_does_not(page, run):
    other = _repeat(run, run.path.with_name("other"))
    assert "stand/other same settings identical" in page(run).section("trust")
    manifest = other.manifest()
    manifest.data["files"]["params/env.yaml"]["sha256"] = "0" * 64
    manifest.record(files=manifest.data["files"])
    assert "Reproducibility Untested" in page(run).text


def test_a_replay_is_compared_with_its_original(page, run, root):
    replay = _repeat(run, root / "replays" / "stand" / "again", replay_of=run.id)
    found = page(replay)
    assert f"This run is itself a replay of {run.id}" in found.section("trust")
    assert f"stand/{run.id} original identical" in found.section("trust")
    assert "Reproducibility Proven" in found.text
