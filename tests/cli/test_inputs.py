from __future__ import annotations

import pytest
from jobs.small import TINY, refused, wheelleg
from refused import refusal

from wheelleg_exp.paths import assets_dir

pytestmark = pytest.mark.usefixtures("own_folders")

# Wrong overrides, and parts of their messages. All mistakes in a config are reported together, so each set of overrides
# is one command. The ranges of values are tested in test_parameter_values.py.
REPORTED_TOGETHER = [
    {
        "recording.steps=0": ["at least 1"],
        "env.rewards.alive.weight=heavy": ["a number"],
        "env.robot.base=flying": ["floating"],
        "+env.rewards.terminating.wieght=2": ["takes no parameter 'wieght'", "did you mean 'weight'?"],
        "+env.extra=1": ["nothing reads this key"],
        "env.rewards.lin_vel_z._target_=os.system": ["outside the allowed packages", "wheelleg_exp.mdp"],
        "env.rewards.ang_vel_xy._target_=torch.load": ["outside the allowed packages"],
        "env.rewards.base_height._target_=wheelleg_exp.mdp.rewards.base_hight_l2": ["did you mean 'base_height_l2'?"],
        "agent.actor.activation=eluu": ["did you mean 'elu'?"],
        "agent.obs_groups.actor=[]": [],
        "recording.env_ids=[99]": ["from 0 to 15"],
    },
    {
        "env.num_envs=many": ["a whole number"],
        "env.actions.leg_pos.joint_names=[nothing]": ["matches nothing", "l01, r01"],
        "agent.algorithm.class_name=subprocess:run": ["outside the allowed packages"],
        "run.name=a/b": ["letters, digits"],
        "agent.max_iterations=-5": ["at least 1"],
        "agent.num_steps_per_env=1.5": ["a whole number"],
        "agent.torch_threads=true": ["a whole number"],
        "agent.obs_groups.actor=[polcy]": ["did you mean 'policy'?"],
        "recording.enabled=perhaps": ["true or false"],
        "seed=abc": ["a whole number"],
        "env.decimation=null": ["a whole number"],
        "env.rewards.base_height.target_height=[1,2]": ["a number"],
    },
]
# Only one mistake is reported if it is found while the config is composed or built.
REPORTED_ALONE = {
    # keys and groups
    "env.rewards.alive.wieght=2": ["no such key", "did you mean 'env.rewards.alive.weight'?"],
    "task=stnd": ["expected one of", "did you mean 'stand'?"],
    "reward@env.rewards=[alvie]": ["did you mean 'alive'?"],
    "env.robot.asset=nowhere/robot.usda": ["there is no file", "nowhere/robot.usda"],
    # the agent
    "agent.torch_threads=100000": [],
    "agent.device=cuda:77": [],
    "agent.device=cudaa": [],
}


def key_of(override: str) -> str:
    return override.split("=")[0].lstrip("+~").split("@")[0]


@pytest.mark.parametrize("override", REPORTED_ALONE)
def test_a_wrong_override_is_reported_with_its_key_and_source_and_leaves_nothing_behind(override, tmp_path):
    line = refusal("train", *TINY, "agent.max_iterations=1", override)
    expected = (key_of(override), f"override {override}", *REPORTED_ALONE[override])
    assert [word for word in expected if word not in line] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("wrong", REPORTED_TOGETHER, ids=["keys", "types"])
def test_every_mistake_of_a_config_is_reported_at_once_and_leaves_nothing_behind(wrong, tmp_path):
    said = wheelleg("train", *TINY, *wrong)
    assert (said.status, said.out) == (2, "")
    for override, words in wrong.items():
        (line,) = [text for text in said.err.splitlines() if f"(override {override})" in text]
        assert [word for word in (key_of(override), *words) if word not in line] == []
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["zero-agent", "random-agent"])
def test_agents_refuse_the_same_overrides(command, tmp_path):
    wrong = ["env.decimation=0", "env.actions.leg_pos.joint_names=[nothing]", "recording.env_ids=[99]"]
    said = refused(command, "env.num_envs=2", "env.sim.nthread=1", *wrong)
    assert [override for override in wrong if f"(override {override})" not in said] == []
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_value_in_a_file_is_reported_with_file_and_line(tmp_path):
    folder = tmp_path / "configs" / "task"
    folder.mkdir(parents=True)
    text = "# @package _global_\ndefaults: [stand, _self_]\nenv:\n  actions:\n    leg_pos: {joint_names: [nothing]}\n"
    (folder / "mine.yaml").write_text(text)
    line = refusal("train", "--config-dir", "configs", "task=mine", *TINY)
    assert "env.actions.leg_pos.joint_names" in line
    assert "configs/task/mine.yaml:5" in line
    assert not (tmp_path / "runs").exists()


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


@pytest.mark.parametrize("words", [["seed=1,2"], ["--sweep"], ["env.num_envs"], ["=3"], ["--config-dir", "nowhere"]])
def test_words_that_are_not_overrides_are_refused(words, tmp_path):
    line = refusal("train", *words)
    assert words[-1].split("=")[0] in line
    assert list(tmp_path.iterdir()) == []
