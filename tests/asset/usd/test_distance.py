"""USD's distance joints become spatial tendons."""

import mujoco
import numpy as np
import pytest

from ..small_usd import SI, converted, hinge, link, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    upAxis = "Z"'


def roped(folder, text: str, *, apis: str = "", header: str = SI, world: bool = False):
    place = "point3f physics:localPos0 = (1, 0, 0)\n point3f physics:localPos1 = (0, 2, 0)"
    joint = hinge("rope", "a", "b", kind="Distance", apis=apis, text=f"{place}\n{text}")
    if world:
        joint = joint.replace("rel physics:body0 = </bot/a>\n", "")
    return converted(write(folder, link("a") + link("b", "(4, 0, 0)") + joint, header=header))


@pytest.mark.parametrize(
    ("low", "high", "header", "expected"),
    [
        (1, 5, SI, (1, 5)),
        (-1, 5, SI, (0, 5)),
        (2, -1, SI, (2, 1e6)),
        (3, 3, SI, (3 * (1 - 1e-4), 3 * (1 + 1e-4))),
        (0, 50, CM, (0, 0.5)),
    ],
)
def test_the_distances_limit_a_tendon_between_joint_frames_of_bodies_that_do_not_touch(
    tmp_path, low, high, header, expected
):
    text = f"float physics:minDistance = {low}\n float physics:maxDistance = {high}"
    model, _ = roped(tmp_path, text, header=header)
    assert (model.ntendon, model.nv, model.nexclude) == (1, 12, 1)
    assert model.tendon_limited[0]
    np.testing.assert_allclose(model.tendon_range[0], expected, rtol=1e-9)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ten_length[0] == pytest.approx(np.hypot(4 - 1, 2) * (1 if header == SI else 0.01))


def test_a_rope_to_the_world_starts_there(tmp_path):
    model, _ = roped(tmp_path, "float physics:maxDistance = 5", world=True)
    assert model.site("rope_end_a").bodyid[0] == 0
    np.testing.assert_allclose(model.site("rope_end_a").pos, [1, 0, 0])


def test_no_distance_at_all_holds_the_points_together(tmp_path):
    model, _ = roped(tmp_path, "float physics:minDistance = 0\n float physics:maxDistance = 0")
    assert (model.ntendon, model.neq, model.eq_type[0]) == (0, 1, mujoco.mjtEq.mjEQ_CONNECT)


def test_physx_springs_at_the_ends_are_springs_with_a_dead_band(tmp_path):
    prefix = "physxPhysicsDistanceJoint"
    text = f"float physics:minDistance = 1\n float physics:maxDistance = 2\n bool {prefix}:springEnabled = 1\n"
    text += f"float {prefix}:springStiffness = 30\n float {prefix}:springDamping = 4"
    model, _ = roped(tmp_path, text, apis="PhysxPhysicsDistanceJointAPI")
    assert not model.tendon_limited[0]
    springs = np.ravel([model.tendon_stiffness[0], model.tendon_damping[0]])
    np.testing.assert_allclose(springs, [30, 4])
    np.testing.assert_allclose(model.tendon_lengthspring[0], [1, 2])


def test_a_rope_without_distances_is_named(tmp_path):
    model, done = roped(tmp_path, "")
    assert model.ntendon == 0
    assert any("/bot/rope" in warning for warning in done.report.warnings)
