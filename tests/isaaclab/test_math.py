"""Rotations, frames, and cameras under Isaac Lab's names, compared with MuJoCo and values computed by hand."""

import math

import mujoco
import numpy as np
import pytest
import torch

from wheelleg_exp.isaaclab.utils import math as m

T = torch.tensor
HALF = math.sqrt(0.5)
ABOUT_Z = T([[HALF, 0.0, 0.0, HALF]])  # by 90 degrees
GEN = torch.Generator().manual_seed(7)
QUATS = torch.nn.functional.normalize(torch.randn(20, 4, generator=GEN), dim=1)
OTHERS = torch.nn.functional.normalize(torch.randn(20, 4, generator=GEN), dim=1)
VECTORS = torch.randn(20, 3, generator=GEN)


def close(got, expected):
    torch.testing.assert_close(got, torch.as_tensor(np.asarray(expected), dtype=got.dtype), atol=2e-6, rtol=2e-6)


def by_mujoco(function, width, *rows):
    """Call a MuJoCo function row by row."""
    found = []
    for row in zip(*(r.double().numpy() for r in rows), strict=True):
        out = np.zeros(width)
        function(out, *row)
        found.append(out)
    return np.array(found)


def test_products_and_rotations_are_mujocos():
    close(m.quat_mul(QUATS, OTHERS), by_mujoco(mujoco.mju_mulQuat, 4, QUATS, OTHERS))
    close(m.quat_apply(QUATS, VECTORS), by_mujoco(mujoco.mju_rotVecQuat, 3, VECTORS, QUATS))
    close(m.matrix_from_quat(3.0 * QUATS).flatten(1), by_mujoco(mujoco.mju_quat2Mat, 9, QUATS))
    close(m.quat_unique(m.quat_from_matrix(m.matrix_from_quat(QUATS))), m.quat_unique(QUATS))
    assert torch.equal(m.quat_rotate(QUATS, VECTORS), m.quat_apply(QUATS, VECTORS))
    with pytest.raises(ValueError, match="shapes"):
        m.quat_mul(QUATS, QUATS[:3])


def test_types_are_promoted_angles_are_broadcast_and_results_can_be_viewed():
    assert m.quat_mul(QUATS, OTHERS.double()).dtype == torch.float64
    close(m.matrix_from_quat(QUATS).view(-1, 9), by_mujoco(mujoco.mju_quat2Mat, 9, QUATS))
    assert m.quat_from_euler_xyz(T([0.0]), T([0.0]), torch.zeros(5)).tolist() == 5 * [[1.0, 0.0, 0.0, 0.0]]


def test_rotations_and_vectors_may_have_other_leading_shapes():
    quat = m.random_orientation(6, "cpu")
    vec = torch.randn(6, 1, 3)
    expected = torch.stack([m.matrix_from_quat(q) @ v[0] for q, v in zip(quat, vec, strict=True)]).unsqueeze(1)
    torch.testing.assert_close(m.quat_apply(quat, vec), expected)
    torch.testing.assert_close(m.quat_apply_inverse(quat, expected), vec)


def test_half_turns_have_quaternions_too():
    """The trace of the matrix is -1, so the largest component is not w."""
    for axis in range(3):
        half_turn = torch.zeros(1, 4)
        half_turn[0, 1 + axis] = 1.0
        close(m.quat_from_matrix(m.matrix_from_quat(half_turn)).abs(), half_turn)


def test_rotation_vectors_are_mujocos():
    error = by_mujoco(mujoco.mju_subQuat, 3, OTHERS, QUATS)
    close(m.quat_apply_inverse(QUATS, m.quat_box_minus(OTHERS, QUATS)), error)
    close(m.quat_error_magnitude(OTHERS, QUATS), np.linalg.norm(error, axis=1))
    close(m.quat_box_plus(QUATS, m.quat_box_minus(OTHERS, QUATS)), m.quat_unique(OTHERS))
    axis = by_mujoco(mujoco.mju_axisAngle2Quat, 4, VECTORS / VECTORS.norm(dim=1, keepdim=True), T([0.7]).expand(20))
    close(m.quat_from_angle_axis(T([0.7]).expand(20), VECTORS), axis)


def test_functions_agree_with_values_computed_by_hand():
    close(m.quat_apply(ABOUT_Z, T([[1.0, 0.0, 2.0]])), [[0.0, 1.0, 2.0]])
    close(m.quat_apply_inverse(ABOUT_Z, T([[1.0, 0.0, 2.0]])), [[0.0, -1.0, 2.0]])
    close(m.quat_conjugate(T([[1.0, 2.0, 3.0, 4.0]])), [[1.0, -2.0, -3.0, -4.0]])
    close(m.quat_inv(T([[1.0, 2.0, 2.0, 4.0]])), [[0.04, -0.08, -0.08, -0.16]])  # over 25
    close(m.quat_unique(T([[-0.5, 0.5, -0.5, 0.5]])), [[0.5, -0.5, 0.5, -0.5]])
    close(m.convert_quat(T([[1.0, 2.0, 3.0, 4.0]])), [[2.0, 3.0, 4.0, 1.0]])
    assert m.convert_quat(np.arange(4.0), "wxyz").tolist() == [3.0, 0.0, 1.0, 2.0]
    close(m.skew_symmetric_matrix(T([1.0, 2.0, 3.0])), [[[0, -3, 2], [3, 0, -1], [-2, 1, 0]]])
    close(m.scale_transform(T([1.0, 2.0]), T(0.0), T(2.0)), [0.0, 1.0])
    close(m.unscale_transform(T([0.0, 1.0]), T(0.0), T(2.0)), [1.0, 2.0])
    close(m.saturate(T([-2.0, 0.0, 2.0]), T(-1.0), T(1.5)), [-1.0, 0.0, 1.5])
    close(m.copysign(2.0, T([-0.1, 3.0])), [-2.0, 2.0])
    close(m.normalize(T([[3.0, 4.0], [0.0, 0.0]])), [[0.6, 0.8], [0.0, 0.0]])
    close(m.wrap_to_pi(T([math.pi, -math.pi, 3 * math.pi / 2])), [math.pi, -math.pi, -math.pi / 2])
    close(m.axis_angle_from_quat(T([[1.0, 1e-8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]])), [[2e-8, 0, 0], [0, 0, 0]])
    close(m.quat_slerp(T([1.0, 0, 0, 0]), -ABOUT_Z[0], 0.5), [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)])
    close(m.quat_slerp(ABOUT_Z[0], ABOUT_Z[0], 0.3), ABOUT_Z[0])
    # At x = 1, 2 rad/s about z are 2 m/s along y, which is x in a frame turned by 90 degrees.
    linear, angular = m.rigid_body_twist_transform(T([[0.0, 0, 0]]), T([[0.0, 0, 2]]), T([[1.0, 0, 0]]), ABOUT_Z)
    close(torch.cat((linear, angular)), [[2.0, 0, 0], [0.0, 0, 2]])


def test_euler_angles():
    angles = T([[0.3, -0.4, 2.5], [-1.0, 0.7, -3.0]])
    quat = m.quat_from_euler_xyz(*angles.unbind(1))
    for got, expected in zip(m.euler_xyz_from_quat(quat), angles.unbind(1), strict=True):
        close(got, expected)
    expected = []
    for roll, pitch, yaw in angles.double().tolist():
        turn = np.zeros(4)
        mujoco.mju_euler2Quat(turn, np.array([roll, pitch, yaw]), "XYZ")  # about fixed axes
        expected.append(turn)
    close(quat, expected)
    close(m.matrix_from_euler(angles.flip(1), "ZYX"), m.matrix_from_quat(quat))
    assert all((angle >= 0).all() for angle in m.euler_xyz_from_quat(quat, wrap_to_2pi=True))
    close(m.yaw_quat(quat), m.quat_from_euler_xyz(T([0.0, 0.0]), T([0.0, 0.0]), angles[:, 2]))
    close(m.quat_apply_yaw(quat, T([[1.0, 0, 0]] * 2)), [[math.cos(a), math.sin(a), 0] for a in (2.5, -3.0)])


def test_frames():
    position, turn = m.combine_frame_transforms(VECTORS, QUATS, VECTORS.flip(0), OTHERS)
    close(position, VECTORS + m.quat_apply(QUATS, VECTORS.flip(0)))
    back = m.subtract_frame_transforms(VECTORS, QUATS, position, turn)
    close(back[0], VECTORS.flip(0))
    close(m.quat_unique(back[1]), m.quat_unique(OTHERS))
    whole = m.make_pose(VECTORS, m.matrix_from_quat(QUATS)) @ m.make_pose(VECTORS.flip(0), m.matrix_from_quat(OTHERS))
    close(whole, m.make_pose(position, m.matrix_from_quat(turn)))
    close(m.pose_inv(whole), torch.linalg.inv(whole))
    close(m.unmake_pose(whole)[0], position)
    points = torch.randn(20, 5, 3, generator=GEN)
    expected = torch.einsum("nij,npj->npi", m.matrix_from_quat(QUATS), points) + VECTORS.unsqueeze(1)
    close(m.transform_points(points, VECTORS, QUATS), expected)
    close(m.transform_points(points[0], VECTORS[0], QUATS[0]), expected[0])


def test_pose_errors_are_undone():
    error = torch.cat(m.compute_pose_error(VECTORS, QUATS, VECTORS.flip(0), OTHERS), dim=1)
    position, turn = m.apply_delta_pose(VECTORS, QUATS, error)
    close(position, VECTORS.flip(0))
    close(m.quat_unique(turn), m.quat_unique(OTHERS))
    assert m.is_identity_pose(torch.zeros(2, 3), T([[1.0, 0, 0, 0]] * 2))
    assert not m.is_identity_pose(torch.zeros(2, 3), QUATS[:2])


def test_random_draws_have_the_moments_of_their_distributions():
    torch.manual_seed(0)
    drawn = m.sample_uniform(T([-1.0, 2.0]), T([1.0, 6.0]), (20000, 2), "cpu")
    assert drawn.mean(0).tolist() == pytest.approx([0.0, 4.0], abs=0.05)
    assert drawn.std(0).tolist() == pytest.approx([2 / 12**0.5, 4 / 12**0.5], abs=0.02)
    drawn = m.sample_log_uniform(0.1, 10.0, 20000, "cpu").log10()
    assert (float(drawn.mean()), float(drawn.std())) == pytest.approx((0.0, 2 / 12**0.5), abs=0.02)
    drawn = m.sample_gaussian(1.0, 2.0, (20000,), "cpu")
    assert (float(drawn.mean()), float(drawn.std())) == pytest.approx((1.0, 2.0), abs=0.05)
    assert m.random_orientation(20000, "cpu").square().mean(0).tolist() == pytest.approx([0.25] * 4, abs=0.01)
    yaw = m.random_yaw_orientation(100, "cpu")
    assert not yaw[:, 1:3].any()
    assert (yaw.norm(dim=1) - 1).abs().max() < 1e-6
    side = m.sample_cylinder(2.0, (1.0, 3.0), 1000, "cpu")
    close(side[:, :2].norm(dim=1), [2.0] * 1000)
    assert 1.0 <= float(side[:, 2].min()) <= float(side[:, 2].max()) <= 3.0
    assert m.default_orientation(2, "cpu").tolist() == 2 * [[1.0, 0.0, 0.0, 0.0]]
    drawn = m.sample_triangle(-1.0, 1.0, 20000, "cpu")
    assert float(drawn.abs().mean()) == pytest.approx(2 / 3, abs=0.01)


# --- cameras ---

FIXED = torch.tensor([[50.0, 0.0, 4.0], [0.0, 40.0, 3.0], [0.0, 0.0, 1.0]])
AXES = {"opengl": ((0, 1.0), (1, 1.0), (2, -1.0)), "ros": ((0, 1.0), (1, -1.0), (2, 1.0))}
AXES["world"] = ((1, -1.0), (2, 1.0), (0, 1.0))  # axis and sign of right, up, and forward


def three(quat, convention):
    """Return right, up, and forward of a camera."""
    matrix = m.matrix_from_quat(quat)
    return torch.stack([sign * matrix[..., axis] for axis, sign in AXES[convention]], dim=-1)


@pytest.mark.parametrize("origin", AXES)
@pytest.mark.parametrize("target", AXES)
def test_a_camera_looks_the_same_way_by_every_convention(origin, target):
    turned = m.convert_camera_frame_orientation_convention(QUATS.view(2, 10, 4), origin, target)
    torch.testing.assert_close(three(turned, target), three(QUATS.view(2, 10, 4), origin), atol=1e-6, rtol=0)


def test_a_view_looks_from_the_eye_at_the_target_with_up_above():
    eyes, targets = torch.tensor([[1.0, 2.0, 3.0], [0.0, 0.0, 5.0]]), torch.tensor([[4.0, 2.0, 3.0], [0.0, 0.0, 1.0]])
    level, down = m.create_rotation_matrix_from_view(eyes, targets)
    torch.testing.assert_close(level, torch.tensor([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    torch.testing.assert_close(down, torch.eye(3))


def test_a_point_is_seen_where_two_lines_cross():
    """The pixel is 50 * 0.2 / 2 + 4 = 9 and 40 * -0.1 / 2 + 3 = 1."""
    points = torch.tensor([[0.2, -0.1, 2.0], [0.0, 0.0, 1.0]])
    seen = m.project_points(points, FIXED)
    torch.testing.assert_close(seen, torch.tensor([[9.0, 1.0, 2.0], [4.0, 3.0, 1.0]]))
    assert m.project_points(points.expand(3, 2, 3), FIXED.expand(3, 3, 3)).shape == (3, 2, 3)


@pytest.mark.parametrize("shape", [(6, 8), (6, 8, 1), (2, 6, 8), (2, 6, 8, 1)])
def test_points_of_pixels_are_seen_at_them_again(shape):
    depth = 1.0 + torch.rand(shape, generator=GEN)
    points = m.unproject_depth(depth, FIXED)
    seen = m.project_points(points, FIXED).reshape(-1, 8, 6, 3)
    torch.testing.assert_close(seen[..., 0], torch.arange(8.0).view(1, 8, 1).expand(len(seen), 8, 6), atol=1e-5, rtol=0)
    torch.testing.assert_close(seen[..., 1], torch.arange(6.0).expand(len(seen), 8, 6), atol=1e-5, rtol=0)
    torch.testing.assert_close(seen[..., 2].transpose(1, 2).reshape(shape), depth)
    assert points.dim() == (2 if shape in ((6, 8), (6, 8, 1)) else 3)
    rays = points.norm(dim=-1).reshape(-1, 8, 6).transpose(1, 2).reshape(shape)
    torch.testing.assert_close(m.orthogonalize_perspective_depth(rays, FIXED), depth)
    torch.testing.assert_close(m.unproject_depth(rays, FIXED, is_ortho=False), points)


# --- TorchScript ---


def scripted(q: torch.Tensor, p: torch.Tensor, v: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    position, turn = m.compute_pose_error(v, q, v, p)
    moved = m.combine_frame_transforms(v, m.quat_mul(q, p), position + turn)[0] + m.wrap_to_pi(v)
    moved = m.transform_points(moved, quat=m.quat_box_plus(q[:1], v[:1]))
    angles = torch.stack(m.euler_xyz_from_quat(q, wrap_to_2pi=True), dim=1)
    return moved, angles, m.quat_slerp(q[0], p[0], 0.3) + m.default_orientation(1, device="cpu")


def test_scripted_functions_call_them_with_the_same_results():
    for by_script, as_usual in zip(
        torch.jit.script(scripted)(QUATS, OTHERS, VECTORS), scripted(QUATS, OTHERS, VECTORS), strict=True
    ):
        assert torch.equal(by_script, as_usual)


# The functions that Isaac Lab 2.3.2 compiles with TorchScript, and three whose decorators it has commented out
SCRIPTED = """
scale_transform unscale_transform saturate normalize wrap_to_pi copysign quat_unique matrix_from_quat
quat_conjugate quat_inv quat_from_euler_xyz quat_from_matrix euler_xyz_from_quat axis_angle_from_quat
quat_from_angle_axis quat_mul yaw_quat quat_box_minus quat_box_plus quat_apply quat_apply_inverse
quat_apply_yaw quat_error_magnitude skew_symmetric_matrix combine_frame_transforms subtract_frame_transforms
compute_pose_error apply_delta_pose transform_points orthogonalize_perspective_depth unproject_depth
project_points default_orientation random_orientation random_yaw_orientation
"""


@pytest.mark.parametrize("name", SCRIPTED.split())
def test_torch_script_compiles(name):
    assert torch.jit.script(getattr(m, name))
