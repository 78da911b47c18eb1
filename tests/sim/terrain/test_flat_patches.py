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


def test_places_lie_in_ranges_that_are_seen_from_the_origin_and_cut_to_the_tile():
    x, y, _ = places(x_range=(-0.6, 9.0), y_range=(0.1, 0.7)).T
    for found, low, high in ((x, -0.6, 1.0 - ORIGIN[0]), (y, 0.1, 0.7)):
        assert low <= found.min() <= low + 0.02
        assert high - 0.02 <= found.max() <= high


def test_no_place_lies_across_the_step_and_each_has_its_height_above_the_origin():
    x, _, z = places().T
    low, away = x + ORIGIN[0] < EDGE, np.abs(x + ORIGIN[0] - EDGE).min()
    assert 0.1 - 1e-9 <= away <= 0.12
    assert 0 < low.sum() < len(low)
    assert z[low].tolist() == pytest.approx([-0.1] * low.sum())
    assert z[~low].tolist() == pytest.approx([0.2] * (~low).sum())


def test_a_place_across_the_step_has_the_height_of_its_middle():
    x, _, z = places(max_height_diff=0.5).T
    low = x + ORIGIN[0] <= EDGE
    assert np.abs(x + ORIGIN[0] - EDGE).min() < 0.05
    assert z[low].tolist() == pytest.approx([-0.1] * low.sum())
    assert z[~low].tolist() == pytest.approx([0.2] * (~low).sum())


@pytest.mark.parametrize(("z_range", "height"), [((-1.0, 0.1), -0.1), ((0.1, 1.0), 0.2)])
def test_the_whole_of_a_place_is_within_its_range_of_heights(z_range, height):
    x, _, z = places(max_height_diff=0.5, z_range=z_range).T
    assert set(z.round(6)) == {height}
    assert np.abs(x + ORIGIN[0] - EDGE).min() >= 0.1 - 1e-9
