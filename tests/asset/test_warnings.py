"""MuJoCo's own warnings during a conversion become warnings of the report."""

import math

import mujoco

from wheelleg_exp.asset import convert_robot
from wheelleg_exp.asset.mjcf import compile_mjcf

from .small_usd import link, write

FALLING = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"


def _provoke() -> None:
    model = mujoco.MjModel.from_xml_string(FALLING)
    data = mujoco.MjData(model)
    data.qpos[0] = math.nan
    mujoco.mj_step(model, data)


def test_a_warning_of_mujoco_is_in_the_report_and_in_no_log_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load = compile_mjcf.load

    def odd(path, source):
        _provoke()
        return load(path, source)

    monkeypatch.setattr(convert_robot, "load", odd)
    done = convert_robot.convert(write(tmp_path, link("a")), tmp_path / "out.xml")
    (warning,) = [text for text in done.report.warnings if text.startswith("MuJoCo: ")]
    assert "QPOS" in warning
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()
    assert mujoco.get_mju_user_warning() is None
