"""Every stock task fits robots that `wheelleg new` made."""

from __future__ import annotations

from pathlib import Path

import pytest
from jobs.small import TINY, succeed
from patience import thinned

from project.robots import edited, four_legs, knees, urdf
from wheelleg_exp.config.checking.find_mistakes import find_mistakes
from wheelleg_exp.lint.physics_check import examine
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.project.create import create

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
FRAME = """<link name="camera"/><joint name="mount" type="fixed"><parent link="body"/><child link="camera"/></joint>
</robot>"""


def with_frame(folder: Path) -> Path:
    """Write a robot with a link without mass, as many URDFs have for a camera."""
    return edited(knees(folder), ("</robot>", FRAME))


ROBOTS = {"kneed": with_frame, "four": four_legs}
# Each second pair contains all tasks, and both robots alternate.
PAIRS = [(task, robot) for n, task in enumerate(TASKS) for robot in (list(ROBOTS) * 2)[n % 2 :][:2]]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("robots")
    return {name: create(folder / name, draw(folder / f"{name}_file")).path for name, draw in ROBOTS.items()}


@pytest.mark.parametrize(("task", "robot"), thinned(PAIRS, 2))
def test_a_stock_task_has_neither_mistakes_nor_implausible_numbers(made, robot, task):
    folders, words = [made[robot] / "configs"], [f"task={task}", f"robot={robot}"]
    composed, mistakes = find_mistakes(words, config_dirs=folders)
    assert mistakes == []
    if task != "article":  # It contains the article's numbers.
        assert [finding.line() for finding in examine(composed).open] == []


def test_a_robot_without_leg_joints_walks_and_a_task_for_legs_says_what_it_lacks(tmp_path):
    stiff = edited(urdf(tmp_path / "file"), ('type="revolute"', 'type="fixed"'))
    folders = [create(tmp_path / "stiff", stiff).path / "configs"]
    composed, mistakes = find_mistakes(["task=walk", "robot=stiff"], config_dirs=folders)
    assert (mistakes, list(composed.config["env"]["actions"])) == ([], ["wheel_vel"])
    assert "env.actions.leg_pos" in composed.terms_without_role
    _, (mistake, *_) = find_mistakes(["task=height", "robot=stiff"], config_dirs=folders)
    assert "the robot has no leg joints" in str(mistake)


@pytest.mark.train
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_stock_task_trains_and_says_what_it_leaves_out(made, robot, monkeypatch):
    monkeypatch.chdir(made[robot])
    words = [word for word in TINY if "episode_length" not in word]
    words += ["agent.max_iterations=1", "agent.warm_start=1", "recording.enabled=false"]
    said = succeed("train", "task=walk", f"robot={robot}", "realism=full", *words)
    assert ("no warm start: the reference controller can only balance" in said.err) == (robot == "four")
