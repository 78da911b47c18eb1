from __future__ import annotations

import pytest
from jobs.small import TINY, refused
from refused import refusal

from wheelleg_exp.paths import assets_dir

pytestmark = pytest.mark.usefixtures("own_folders")
# Only one mistake is reported if it is found while the config is composed or built.
REPORTED_ALONE = {
    # keys and groups
    "env.robot.asset=nowhere/robot.usda": ["there is no file", "nowhere/robot.usda"],
    # the agent
    "agent.torch_threads=100000": [],
    "agent.device=cuda:77": [],
}


def key_of(override: str) -> str:
    return override.split("=")[0].lstrip("+~").split("@")[0]


@pytest.mark.parametrize("override", REPORTED_ALONE)
def test_a_wrong_override_is_reported_with_its_key_and_source_and_leaves_nothing_behind(override, tmp_path):
    line = refusal("train", *TINY, "agent.max_iterations=1", override)
    expected = (key_of(override), f"override {override}", *REPORTED_ALONE[override])
    assert [word for word in expected if word not in line] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [["compose", "robot=physical"], ["compose", "--shapes"], ["explain", "env.sim.dt"]])
def test_a_phase_of_a_pipeline_is_composed_without_the_pipeline(words):
    said = refusal(*words, "pipeline=first_drive")
    assert f"{words[1]}: the config of a pipeline has only the key 'pipeline'" in said
    assert "the overrides of one phase, such as task=walk, instead of pipeline=" in said


@pytest.mark.parametrize("command", ["zero-agent", "random-agent"])
def test_agents_refuse_the_same_overrides(command, tmp_path):
    wrong = ["env.decimation=0", "env.actions.leg_pos.joint_names=[nothing]", "recording.env_ids=[99]"]
    said = refused(command, "env.num_envs=2", "env.sim.nthread=1", *wrong)
    assert [override for override in wrong if f"(override {override})" not in said] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "robot.usda"),
        ('#usda 1.0\ndef Xform "robot" {}\n', "articulation"),
        ('#usda 1.0\ndef Xform "robot" {\n', "robot.usda"),
        ((assets_dir() / "wheelleg" / "wheelleg.usda").read_text(), "robot.usda"),
    ],
    ids=["empty", "without articulation", "cut off", "without its references"],
)
def test_a_robot_file_without_a_robot_is_refused(tmp_path, text, word):
    (tmp_path / "robot.usda").write_text(text)
    line = refusal("train", *TINY, f"env.robot.asset={tmp_path / 'robot.usda'}")
    assert word in line
    assert not (tmp_path / "runs").exists()


def test_a_run_root_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "runs").write_text("a file, not a folder")
    assert "run" in refusal("train", *TINY, "agent.max_iterations=1", "run.root=runs")
    assert (tmp_path / "runs").read_text() == "a file, not a folder"
