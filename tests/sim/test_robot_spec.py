import mujoco
import numpy as np
import pytest

from wheelleg_exp.sim.robot_model import turn_root_frame

FRAME = np.array([0.3, 0.5, -0.2, 0.7])
INERTIAS = (
    '<inertial pos="0.1 0.02 0" mass="2" diaginertia="1 2 2.5" quat="0.9 0.1 0 0.2"/>',
    '<inertial pos="0.1 0.02 0" mass="2" fullinertia="1 2 2.5 0.1 -0.2 0.3"/>',
    "",
)
ROBOT = """<mujoco><worldbody><body name="root" pos="0 0 1"><freejoint/>{inertial}
  <geom size=".1 .2 .3" type="box" pos=".1 0 0" euler="10 20 30"/>
  <geom type="capsule" fromto="0 0 0 0 .2 .1" size=".02"/><site pos="0 .1 0"/>
  <frame pos="0 0.3 0" euler="0 30 0"><geom size=".1"/></frame>
  <body name="arm" pos="0 0.2 0" quat="0.5 0.5 0.5 0.5"><joint name="joint" axis="0 1 0"/>
    <geom size=".1 .1" type="cylinder"/></body>
</body></worldbody></mujoco>"""


def placed(inertial: str, *, turned: bool) -> tuple[mujoco.MjModel, mujoco.MjData]:
    spec = mujoco.MjSpec.from_string(ROBOT.format(inertial=inertial))
    if turned:
        turn_root_frame(spec, "root", 3.0 * FRAME)  # a quaternion of length 3
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[3:7] = FRAME / np.linalg.norm(FRAME) if turned else [1, 0, 0, 0]
    data.qpos[7] = 0.3
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("inertial", INERTIAS)
def test_turning_the_root_frame_moves_nothing(inertial):
    (model, plain), (other, turned) = placed(inertial, turned=False), placed(inertial, turned=True)
    for field in ("geom_xpos", "geom_xmat", "site_xpos", "xipos", "xanchor", "xaxis", "subtree_com"):
        np.testing.assert_allclose(getattr(turned, field), getattr(plain, field), atol=1e-12, err_msg=field)
    np.testing.assert_allclose(other.body_mass, model.body_mass, rtol=1e-12)
    axes = [data.ximat[1].reshape(3, 3) for data in (plain, turned)]
    tensors = [a @ np.diag(m.body_inertia[1]) @ a.T for a, m in zip(axes, (model, other), strict=True)]
    np.testing.assert_allclose(tensors[1], tensors[0], atol=1e-9)
