"""Pixels and points of cameras, by hand, and the conventions of their frames."""

import pytest
import torch

from wheelleg_exp.isaaclab.utils import math as m

FIXED = torch.tensor([[50.0, 0.0, 4.0], [0.0, 40.0, 3.0], [0.0, 0.0, 1.0]])
GEN = torch.Generator().manual_seed(1)
QUATS = torch.nn.functional.normalize(torch.randn(2, 5, 4, generator=GEN), dim=-1)
AXES = {"opengl": ((0, 1.0), (1, 1.0), (2, -1.0)), "ros": ((0, 1.0), (1, -1.0), (2, 1.0))}
AXES["world"] = ((1, -1.0), (2, 1.0), (0, 1.0))  # axis and sign of right, up, and forward


def three(quat, convention):
    """Return right, up, and forward of a camera."""
    matrix = m.matrix_from_quat(quat)
    return torch.stack([sign * matrix[..., axis] for axis, sign in AXES[convention]], dim=-1)


@pytest.mark.parametrize("origin", AXES)
@pytest.mark.parametrize("target", AXES)
def test_a_camera_looks_the_same_way_by_every_convention(origin, target):
    turned = m.convert_camera_frame_orientation_convention(QUATS, origin, target)
    torch.testing.assert_close(three(turned, target), three(QUATS, origin), atol=1e-6, rtol=0)


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
