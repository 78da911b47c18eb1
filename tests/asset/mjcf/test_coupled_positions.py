"""Joints that follow other joints satisfy MuJoCo's equality constraints, in keyframes, arrays, and tensors."""

import mujoco
import numpy as np
import pytest
import torch

from wheelleg_exp.asset.mjcf.coupled_positions import JointCouplings

from ..small_urdf import joint, link, made

# The follower is listed before its driver, and the last follower before the follower that it follows.
CHAIN = """<mujoco><worldbody>
  <body><geom size=".1"/><joint name="last" type="slide" axis="1 0 0" ref="0.1"/>
    <body pos="0 0 1"><geom size=".1"/><joint name="follower" axis="0 1 0" ref="-17"/>
      <body pos="0 0 1"><geom size=".1"/><joint name="driver" axis="1 0 0" ref="11"/>
        <body pos="0 0 1"><geom size=".1"/><joint name="constant" axis="0 0 1"/><joint name="free"/></body></body>
    </body>
  </body></worldbody><equality>
    <joint joint1="last" joint2="follower" polycoef="0.05 0.2 -0.1 0.3 0.5"/>
    <joint joint1="follower" joint2="driver" polycoef="0.3 -2 1 0.5 -0.25"/>
    <joint joint1="constant" polycoef="0.4 0 0 0 0"/>
    <joint joint1="free" joint2="driver" active="false"/></equality></mujoco>"""


@pytest.mark.parametrize("make", [np.array, torch.tensor])
def test_followers_satisfy_the_equalities_that_mujoco_computes(make):
    model = mujoco.MjModel.from_xml_string(CHAIN)
    drawn = np.random.default_rng(0).uniform(-1, 1, (2, 20, model.nq))
    positions, velocities = make(drawn[0].tolist()), make(drawn[1].tolist())
    JointCouplings(model).follow(positions, velocities)
    for before, q, v in zip(drawn[0], positions.tolist(), velocities.tolist(), strict=True):
        data = mujoco.MjData(model)
        data.qpos, data.qvel = q, v
        mujoco.mj_forward(model, data)
        same = [model.joint(name).qposadr[0] for name in ("driver", "free")]
        assert data.qpos[same] == pytest.approx(before[same], abs=1e-6)
        tolerance = 1e-4 if make is torch.tensor else 1e-9  # float32
        assert data.efc_pos[:3] == pytest.approx(0, abs=tolerance)
        assert data.efc_vel[:3] == pytest.approx(0, abs=tolerance)


def test_a_driver_stays_where_its_followers_are_inside_their_limits():
    limits = CHAIN.replace('name="follower"', 'name="follower" limited="true" range="-37 3"')  # degrees; ref -17
    model = mujoco.MjModel.from_xml_string(limits.replace("0.3 -2 1 0.5 -0.25", "0 -2 0 0 0"))
    qpos = np.zeros(model.nq)
    driver, follower = (model.joint(name).qposadr[0] for name in ("driver", "follower"))
    for wanted, degrees in ((9.0, 21), (-9.0, 1), (np.radians(15), 15)):
        qpos[driver] = wanted
        JointCouplings(model).follow(qpos)
        assert np.degrees(qpos[driver]) == pytest.approx(degrees, abs=0.05)
        assert -37 - 1e-6 <= np.degrees(qpos[follower]) <= 3 + 1e-6


def test_joints_that_follow_one_another_end():
    circle = CHAIN.replace('joint1="constant"', 'joint1="driver" joint2="last"')
    JointCouplings(mujoco.MjModel.from_xml_string(circle)).follow(np.zeros(5))


def test_the_home_keyframe_of_mimic_joints_is_at_rest(tmp_path):
    limits = '<axis xyz="0 0 1"/><limit lower="-2" upper="2"/>'
    joints = (
        joint("follow", "base", "b", inside=limits + '<mimic joint="drive" multiplier="-2" offset="0.25"/>'),
        joint("drive", "base", "a", inside=limits),
        joint("chain", "b", "c", inside=limits + '<mimic joint="follow" multiplier="0.5" offset="-0.1"/>'),
    )
    model, _ = made(tmp_path, "".join(map(link, ("base", "a", "b", "c"))) + "".join(joints))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    found = [float(data.joint(name).qpos[0]) for name in ("drive", "follow", "chain")]
    assert found == pytest.approx([0.0, 0.25, 0.025])
    model.opt.gravity = 0
    mujoco.mj_step(model, data, 50)
    assert np.abs(data.qvel).max() < 1e-6
