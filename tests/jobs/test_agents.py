"""Zero and random agents: what they record, and that a seed gives the same again."""

import json

import numpy as np
import pytest
import yaml

from jobs.test_play import Silent
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.jobs.play_policy import run_agent
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording

pytestmark = pytest.mark.slow

FEW = ["task=stand", "env.num_envs=2", "env.sim.nthread=1", "run.root=runs"]


def run(kind, *overrides, steps=30):
    return run_agent(kind, compose([*FEW, *overrides]), steps, Silent())


def test_each_wheel_of_a_standing_robot_carries_half_of_its_weight():
    standing = run("zero", "env.num_envs=24", "event@env.events=[reset_base,reset_robot_joints]", steps=60)
    rows = {row.body: row for row in standing.contacts["contact_forces"]}
    wheels = [rows.pop("l_wheel_link"), rows.pop("r_wheel_link")]
    assert [wheel.mean_n for wheel in wheels] == pytest.approx([2.4525] * 2, rel=0.03)
    assert sum(wheel.mean_n for wheel in wheels) == pytest.approx(0.5 * 9.81, rel=0.03)
    assert min(wheel.contact_share for wheel in wheels) > 0.95
    assert all(row.mean_n == 0.0 for row in rows.values())


def test_zero_actions_are_zero_and_random_actions_fill_their_range_with_the_same_first_observation():
    recordings = [Recording(run(kind).recording) for kind in ("zero", "random")]
    zero, random = (recording.values("actions/raw") for recording in recordings)
    assert zero.shape == random.shape == (30, 6)
    assert (zero == 0).all()
    assert (np.abs(random) <= 1.0).all()
    # The mean of 180 draws from U(-1, 1) is 0 with a standard error of 0.043; their standard deviation is 0.577.
    assert abs(random.mean()) < 0.2
    assert random.std() == pytest.approx(1 / 3**0.5, abs=0.1)
    assert np.array_equal(*[recording.values("observations/critic")[0] for recording in recordings])


def test_random_actions_repeat_with_the_seed():
    first, again, other = (run("random", f"seed={seed}") for seed in (3, 3, 4))
    digests = [entity_digests(made.recording) for made in (first, again, other)]
    assert digests[0] == digests[1]
    assert digests[0]["actions/raw"] != digests[2]["actions/raw"]
    assert first.figures == again.figures


def test_the_results_are_stored_below_agents_with_a_recording_unless_it_is_disabled():
    made = run("zero")
    assert made.folder.parent.parts[-3:] == ("runs", "agents", "stand")
    assert sorted(p.name for p in made.folder.iterdir()) == ["config.yaml", "figures.json", "recording.rrd"]
    assert yaml.safe_load((made.folder / "config.yaml").read_text())["env"]["num_envs"] == 2
    figures = json.loads((made.folder / "figures.json").read_text())
    assert (figures["agent"], figures["contacts"]["contact_forces"][0]["body"]) == ("zero", "base_link")
    made = run("zero", "recording.enabled=false")
    assert sorted(p.name for p in made.folder.iterdir()) == ["config.yaml", "figures.json"]


def test_one_episode_is_the_default():
    made = run("zero", "env.episode_length_s=0.2", steps=None)
    assert (len(Recording(made.recording).values("actions/raw")), made.figures.survival) == (12, 1.0)
