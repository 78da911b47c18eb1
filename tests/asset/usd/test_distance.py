"""USD's distance joints become spatial tendons."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from ..small_usd import converted, hinge, link, write

CM = 'defaultPrim = "bot"\n    metersPerUnit = 0.01\n    upAxis = "Z"'


def roped(folder, text: str, *, apis: str = "", header: str = "", world: bool = False):
    place = "point3f physics:localPos0 = (1, 0, 0)\n point3f physics:localPos1 = (0, 2, 0)"
    joint = hinge("rope", "a", "b", kind="Distance", apis=apis, text=f"{place}\n{text}")
    if world:
        joint = joint.replace("rel physics:body0 = </bot/a>\n", "")
    body = link("a", "(0, 0, 0)") + link("b", "(4, 0, 0)") + joint
    return converted(write(folder, body, **({"header": header} if header else {})))


def length(model: mujoco.MjModel) -> float:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return float(data.ten_length[0])


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(1, 5, (1, 5)), (-1, 5, (0, 5)), (2, -1, (2, 1e6)), (3, 3, (3 * (1 - 1e-4), 3 * (1 + 1e-4)))],
)
def test_the_distances_limit_a_tendon_between_the_joint_frames(tmp_path, low, high, expected):
    model, _ = roped(tmp_path, f"float physics:minDistance = {low}\n float physics:maxDistance = {high}")
    assert model.ntendon == 1
    assert model.tendon_limited[0]
    np.testing.assert_allclose(model.tendon_range[0], expected, rtol=1e-9)
    assert (length(model), model.nv) == (pytest.approx(np.hypot(4 - 1, 2)), 12)


def test_distances_are_stage_lengths(tmp_path):
    model, _ = roped(tmp_path, "float physics:maxDistance = 50", header=CM)
    np.testing.assert_allclose(model.tendon_range[0], [0, 0.5], rtol=1e-6)


def test_a_rope_to_the_world_starts_there(tmp_path):
    model, _ = roped(tmp_path, "float physics:maxDistance = 5", world=True)
    assert model.site("rope_end_a").bodyid[0] == 0
    np.testing.assert_allclose(model.site("rope_end_a").pos, [1, 0, 0])


def test_no_distance_at_all_holds_the_points_together(tmp_path):
    model, _ = roped(tmp_path, "float physics:minDistance = 0\n float physics:maxDistance = 0")
    assert (model.ntendon, model.neq) == (0, 1)
    assert model.eq_type[0] == mujoco.mjtEq.mjEQ_CONNECT


def test_physx_springs_at_the_ends_are_springs_with_a_dead_band(tmp_path):
    prefix = "physxPhysicsDistanceJoint"
    text = f"float physics:minDistance = 1\n float physics:maxDistance = 2\n bool {prefix}:springEnabled = 1\n"
    text += f"float {prefix}:springStiffness = 30\n float {prefix}:springDamping = 4"
    model, _ = roped(tmp_path, text, apis="PhysxPhysicsDistanceJointAPI")
    assert not model.tendon_limited[0]
    np.testing.assert_allclose(np.ravel(model.tendon_stiffness)[0], 30)
    np.testing.assert_allclose(np.ravel(model.tendon_damping)[0], 4)
    np.testing.assert_allclose(model.tendon_lengthspring[0], [1, 2])


def test_a_rope_without_distances_is_named(tmp_path):
    model, done = roped(tmp_path, "")
    assert model.ntendon == 0
    assert any("/bot/rope" in warning for warning in done.report.warnings)


def test_bodies_at_both_ends_of_a_rope_do_not_touch(tmp_path):
    model, _ = roped(tmp_path, "float physics:maxDistance = 5")
    assert model.nexclude == 1
