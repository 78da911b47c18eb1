import json

import numpy as np
import pytest
from asset.corpus import ABSENT, corpus_folder
from env.composed import composed
from lint.patients import HEALTHY, seeded
from PIL import Image

from wheelleg_exp.cli.main import main
from wheelleg_exp.project.create import create

pytestmark = pytest.mark.usefixtures("shared_cache")

FLIPPED = seeded(('name="r_axle" axis="0 1 0"', 'name="r_axle" axis="0 -1 0"'))


@pytest.fixture
def file(tmp_path, monkeypatch):
    def write(text):
        path = tmp_path / "robot.xml"
        path.write_text(text)
        return str(path)

    monkeypatch.setattr("wheelleg_exp.lint.diagnosis.compose", lambda words: composed(*words))
    return write


def test_a_healthy_robot_ends_with_0(file, capsys):
    path = file(HEALTHY)
    assert main(["doctor", path]) == 0
    said = capsys.readouterr().out
    assert "0 findings\n" in said
    assert " ".join(said.split()).endswith(f"{path}: nothing to fix")


def test_a_robot_file_is_examined_in_the_folder_of_a_project(file, tmp_path, monkeypatch):
    create(tmp_path / "mine", None)
    monkeypatch.chdir(tmp_path / "mine")
    assert main(["doctor", file(HEALTHY)]) == 0


def test_a_finding_ends_with_1_and_the_one_to_act_on_first(file, capsys):
    assert main(["doctor", file(FLIPPED)]) == 1
    said = capsys.readouterr().out
    assert "wheel_senses  env.robot.asset" in said
    assert "known by  kinematics, v = omega x r" in said
    last = " ".join(said[said.index("1 finding\n") :].split()[2:])
    assert last.startswith("first: positive speed of 'l_axle' rolls the robot forwards")
    assert "action's scale times {l_axle: 1, r_axle: -1}" in last
    assert max(map(len, said.splitlines())) <= 100


def test_json_is_one_document(file, capsys):
    assert main(["doctor", file(FLIPPED), "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert [finding["rule"] for finding in told["findings"]] == ["wheel_senses"]
    assert [wheel["sign"] for wheel in told["anatomy"]["wheels"]] == [1, -1]
    assert told["first"].startswith("first: ")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere.urdf"], "there is no file 'nowhere.urdf'"),
        (["nowhere.xml"], "there is no file"),
        (["task=nothing"], "nothing"),
        (["task=stand", "--screenshot", "picture.jpg"], "ends with .png"),
        ([], "missing"),
        (["FILE", "env.num_envs=2"], "one word too many"),
        (["FILE", "--config-dir", "docs/examples/tron1"], "--config-dir: the option applies only to a task"),
        (["BROKEN"], "MuJoCo cannot read the robot file"),
    ],
)
def test_wrong_input_ends_with_2(file, words, said, capsys):
    texts = {"FILE": HEALTHY, "BROKEN": "<mujoco><worldbody>"}
    assert main(["doctor", *(file(texts[word]) if word in texts else word for word in words)]) == 2
    assert said in capsys.readouterr().err


def test_the_stock_task_has_nothing_to_mend_but_what_it_silences(capsys):
    assert main(["doctor", "task=stand", "--all"]) == 0
    told = capsys.readouterr().out
    assert [
        words for words in ("0 findings, 5 silenced", "silenced  the robot drops by 15 mm") if words not in told
    ] == []
    assert main(["doctor", "task=stand", "env.robot.init_state.rot=[0.995,0,0.0998,0]", "--json"]) == 1
    assert "balance_pose" in [finding["rule"] for finding in json.loads(capsys.readouterr().out)["findings"]]


def test_a_cost_that_outweighs_what_is_earned_at_random(capsys):
    weight = -20.0
    assert main(["doctor", "task=stand", f"env.rewards.ang_vel_xy.weight={weight:g}", "--json"]) == 1
    (found,) = [f for f in json.loads(capsys.readouterr().out)["findings"] if f["rule"] == "reward_outweighs"]
    figures, written = found["figures"], float(found["hint"].split()[3].rstrip(","))
    assert found["key"] == "env.rewards.ang_vel_xy.weight"
    ratio = figures["cost_per_s"] / figures["earned_per_s"]
    assert written == pytest.approx(weight * 4 / ratio, rel=0.1)


@pytest.mark.corpus
def test_robots_that_are_known_to_work_raise_no_alarm(file, request, monkeypatch, capsys):
    folder = corpus_folder(request.config.getoption("--corpus"))
    if folder is None:
        pytest.skip(ABSENT)
    monkeypatch.setenv("WHEELLEG_USD_CORPUS", str(folder))
    assert main(["doctor", "--config-dir", "docs/examples/tron1", "task=tron1_stand"]) == 0
    for name in ("wf_tron1a_isaac/WF_TRON1A.usd", "wf_tron2a_isaac/robot.usd", "wf_tron2a_urdf/bipedal_robot.usda",
                 "upkie/upkie.usda"):  # fmt: skip
        assert main(["doctor", str(folder / "assets" / name)]) == 0, capsys.readouterr().out


@pytest.mark.pictures
def test_a_picture_shows_the_colliders_the_mass_and_the_support(file, tmp_path):
    picture = tmp_path / "robot.png"
    assert main(["doctor", file(HEALTHY), "--screenshot", str(picture)]) == 0
    pixels = np.asarray(Image.open(picture)).astype(int)
    assert pixels.shape == (720, 1440, 3)
    red = (pixels[..., 0] > 110) & (pixels[..., 1] < 60) & (pixels[..., 2] < 60)
    green = (pixels[..., 1] > 60) & (pixels[..., 0] < 50) & (pixels[..., 2] < 80)
    assert red[:, :720].sum() > 100  # The left half of the figure shows the robot's centre of mass from the side.
    assert green[:, 720:].sum() > 100  # The right half of the figure shows the line between the wheels.
    side = np.flatnonzero(red[:, :720].any(axis=0))
    assert abs(side.mean() - 360) < 15  # The centre of mass is over the axle.
    assert main(["doctor", file(HEALTHY), "--screenshot", str(picture)]) == 2  # nothing is overwritten
