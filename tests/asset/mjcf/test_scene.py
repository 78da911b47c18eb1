"""The preview scene of a converted robot: the robot stands still on the floor, even with very stiff gains."""

import mujoco
import numpy as np
import pytest

from wheelleg_exp.asset.mjcf.preview_scene import scene_path, write_scene
from wheelleg_exp.cli.main import main

from ..small_usd import converted, hinge, link, write

CUBE = 'def Cube "c" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{\n double size = 0.2\n}\n'


def settled(model: mujoco.MjModel, key: str | None = None, seconds: float = 2.0, push: float = 0.0) -> mujoco.MjData:
    data = mujoco.MjData(model)
    data.qvel[6:] = push
    if key is not None:
        mujoco.mj_resetDataKeyframe(model, data, model.key(key).id)
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
    return data


@pytest.fixture(scope="module")
def stock(conversion) -> mujoco.MjModel:
    path = write_scene(conversion.description, conversion.output)
    assert path is not None
    return mujoco.MjModel.from_xml_path(str(path))


@pytest.mark.parametrize("key", [None, "stand"])
def test_the_stock_robot_comes_to_rest_on_the_floor(stock, key):
    data = settled(stock, key)
    floor = stock.geom("floor").pos[2]
    assert floor < data.xipos[1, 2] < floor + 0.2
    assert np.abs(data.qvel).max() < 0.05
    assert data.ncon > 0


def test_it_begins_above_the_floor_and_a_keyframe_puts_it_there(stock):
    data = mujoco.MjData(stock)
    mujoco.mj_forward(stock, data)
    assert data.ncon == 0
    assert -0.05 < stock.geom("floor").pos[2] - data.geom("l_wheel_link_cylinder").xpos[2] < -0.02
    mujoco.mj_resetDataKeyframe(stock, data, stock.key("stand").id)
    mujoco.mj_forward(stock, data)
    wheel = data.geom("l_wheel_link_cylinder").xpos[2] - stock.geom("l_wheel_link_cylinder").size[0]
    assert 0 <= wheel - stock.geom("floor").pos[2] < 0.02  # bounding boxes are larger


STIFF = """float drive:angular:physics:stiffness = 20000; float drive:angular:physics:damping = 1
        uniform token drive:angular:physics:type = "force"; point3f physics:localPos0 = (0.3, 0, 0)"""


def test_gains_that_the_time_step_cannot_carry_do_not_tear_the_robot_apart(tmp_path):
    body = link("a", inside=CUBE) + link("b", "(0.3, 0, 0)", inside=CUBE)
    _, done = converted(write(tmp_path, body + hinge("j", "a", "b", text=STIFF)))
    bare = mujoco.MjModel.from_xml_path(str(done.output))
    data = mujoco.MjData(bare)
    data.qvel[-1] = 1.0
    for _ in range(500):
        mujoco.mj_step(bare, data)
    assert data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or np.abs(data.qvel).max() > 100  # unstable
    model = mujoco.MjModel.from_xml_path(str(write_scene(done.description, done.output)))
    assert model.opt.timestep == 0.002
    assert np.abs(settled(model, push=1.0).qvel).max() < 0.1


def test_a_file_of_somebody_elses_is_not_replaced_and_an_older_scene_is(tmp_path):
    _, done = converted(write(tmp_path, link("a", inside=CUBE)))
    first = write_scene(done.description, done.output)
    assert first == scene_path(done.output) == write_scene(done.description, done.output)
    first.write_text("<mujoco/>")
    assert write_scene(done.description, done.output) is None
    assert first.read_text() == "<mujoco/>"


def test_the_command_writes_the_scene_and_prints_how_to_view_it(tmp_path, capsys):
    source = write(tmp_path, link("a", inside=CUBE))
    assert main(["convert", str(source), "-o", str(tmp_path / "bot.xml")]) == 0
    told = capsys.readouterr().out
    assert f"--mjcf={tmp_path / 'bot_scene.xml'}" in told
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bot.usda", "bot.xml", "bot_scene.xml"]
    text = (tmp_path / "bot_scene.xml").read_text()
    assert '<include file="bot.xml"/>' in text
