import numpy as np
import pytest

from wheelleg_exp.sim.terrain.sub_terrains import FlatPatches

EDGE, RISE = 0.5, 0.3  # the position and the height of the step, m
ORIGIN = np.array([0.4, -0.2, 0.1])


def step(points: np.ndarray) -> np.ndarray:
    return np.where(points[..., 0] > EDGE, RISE, 0.0)


def places(max_height_diff: float = 0.0, **ranges) -> np.ndarray:
    wanted = FlatPatches(num_patches=400, patch_radius=0.1, max_height_diff=max_height_diff, **ranges)
    return wanted.find(step, ORIGIN, (2.0, 2.0), np.random.default_rng(0), "key")


def test_patches_are_in_ranges_relative_to_the_origin_and_inside_the_tile():
    x, y, _ = places(x_range=(-0.6, 9.0), y_range=(0.1, 0.7)).T
    for found, low, high in ((x, -0.6, 1.0 - ORIGIN[0]), (y, 0.1, 0.7)):
        assert low <= found.min() <= low + 0.02
        assert high - 0.02 <= found.max() <= high


@pytest.mark.parametrize(("max_height_diff", "near", "far"), [(0.0, 0.1 - 1e-9, 0.12), (0.5, 0.0, 0.05)])
def test_patches_avoid_the_step_unless_its_height_is_allowed(max_height_diff, near, far):
    """Each patch has the height of its middle above the origin."""
    x, _, z = places(max_height_diff).T
    low = x + ORIGIN[0] <= EDGE
    assert near <= np.abs(x + ORIGIN[0] - EDGE).min() <= far
    assert 0 < low.sum() < len(low)
    assert z[low].tolist() == pytest.approx([-0.1] * low.sum())
    assert z[~low].tolist() == pytest.approx([0.2] * (~low).sum())


@pytest.mark.parametrize(("z_range", "height"), [((-1.0, 0.1), -0.1), ((0.1, 1.0), 0.2)])
def test_a_whole_patch_is_within_its_range_of_heights(z_range, height):
    x, _, z = places(max_height_diff=0.5, z_range=z_range).T
    assert set(z.round(6)) == {height}
    assert np.abs(x + ORIGIN[0] - EDGE).min() >= 0.1 - 1e-9
