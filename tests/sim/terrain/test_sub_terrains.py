import numpy as np
import pytest

from sim.terrain.tiles import grid, placed
from wheelleg_exp.sim.terrain import (
    Box,
    DiscreteObstacles,
    Flat,
    Gap,
    PyramidSlope,
    PyramidStairs,
    Rails,
    RandomGrid,
    RandomUniform,
    SteppingStones,
    SubTerrain,
    UniformNoise,
    Waves,
)

CELLS, CORNERS = grid((2.0, 2.0), 0.1, boxes=True), grid((2.0, 2.0), 0.1, boxes=False)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def profile(heights: np.ndarray) -> list[float]:
    return np.round(heights[:, heights.shape[1] // 2], 9).tolist()


def test_flat_ground_is_level():
    assert not Flat(proportion=1).heights(1.0, CELLS, rng()).any()


def test_stairs_rise_a_step_every_width_up_to_the_platform():
    stairs = PyramidStairs(proportion=1, step_height_range=[0.1, 0.3], step_width=0.2, platform_width=0.7)
    # After 4 steps the edge of the top is 2 - 8 * 0.2 = 0.4 m, below the platform width of 0.7 m.
    half = [0, 0, 0.2, 0.2, 0.4, 0.4, 0.6, 0.6, 0.8, 0.8]
    assert profile(stairs.heights(0.5, CELLS, rng())) == pytest.approx(half + half[::-1])
    stairs.inverted = True
    assert profile(stairs.heights(0.0, CELLS, rng())) == pytest.approx([-h / 2 for h in half + half[::-1]])
    corner = stairs.heights(0.0, CELLS, rng())[:10, :10]
    assert np.allclose(corner, np.minimum.outer(range(10), range(10)) // 2 * -0.1)


def test_a_slope_has_its_angle_on_every_face():
    slope = PyramidSlope(proportion=1, slope_range=[0.0, 0.4], platform_width=0.4)
    heights = slope.heights(0.5, CORNERS, rng())
    rise_x, rise_y = np.gradient(heights, 0.1)
    assert (rise_x[2:8, 10], rise_y[10, 13:18]) == (pytest.approx(np.tan(0.2)), pytest.approx(-np.tan(0.2)))
    assert heights.max() == pytest.approx(np.tan(0.2) * 0.8, abs=1e-6)
    assert (heights[8:13, 8:13] == heights.max()).all()
    slope.inverted = True
    assert np.array_equal(slope.heights(0.5, CORNERS, rng()), -heights)


def test_waves_follow_their_formula():
    found = Waves(proportion=1, amplitude_range=[0.0, 0.2], num_waves=2).heights(0.5, CORNERS, rng())
    # The amplitude A is 0.1 m. The wave number k is 2 pi 2 / 2 m, so a quarter of a wave is 0.25 m long.
    for i, j, expected in [(0, 0, 0.05), (5, 0, 0.05), (10, 5, -0.05), (0, 10, 0.05)]:
        assert found[i, j] == pytest.approx(expected, abs=1e-9)
    assert found[2, 3] == pytest.approx(0.05 * (np.cos(0.6 * np.pi) + np.sin(0.4 * np.pi)))


def test_noise_in_steps_has_the_range_and_no_difficulty():
    noise = RandomUniform(proportion=1, noise_range=[-0.02, 0.04], noise_step=0.02)
    found = noise.heights(0.0, CORNERS, rng())
    assert np.unique(found.round(9)).tolist() == pytest.approx([-0.02, 0.0, 0.02, 0.04])
    assert np.array_equal(found, noise.heights(1.0, CORNERS, rng()))


A, RIMS = 0.1, (0.0, 0.25, 0.5, 0.75, 1.0)  # the amplitude, m, and the rims of tiles, in cells
STONES = {"stone_height_max": A, "stone_width_range": [0.5, 0.5], "stone_distance_range": [0.0, 0.0]}
STONES |= {"platform_width": 0.0, "holes_depth": -1.0}
GRID = {"grid_width": 0.3, "grid_height_range": [A, A], "platform_width": 0.0}
PARTS = {  # The values are a sub-terrain's class, its options, and the standard deviation of its heights, m.
    "uniform": (UniformNoise, {"amplitude_range": [A, A]}, A / np.sqrt(3)),
    # Along x and along y, half of the points have the mean of two draws: (1 + 1/2) / 2.
    "every second": (UniformNoise, {"amplitude_range": [A, A], "downsampled_scale": 0.2}, A / np.sqrt(3) * 0.75),
    "steps": (RandomUniform, {"noise_range": [-A, A], "noise_step": A}, A * np.sqrt(2 / 3)),
    "grid": (RandomGrid, GRID, A / np.sqrt(3)),
    "waves": (Waves, {"amplitude_range": [A, A], "num_waves": 2}, A / 2),
    "stones": (SteppingStones, STONES, A / np.sqrt(3)),
}


def inner_heights(part: SubTerrain, scale: float, rim: float, seed: int) -> np.ndarray:
    part.horizontal_scale, part.border_width = scale, rim
    ground = placed({"part": part}, size=[12.0, 12.0], num_rows=1, num_cols=1, difficulty_range=[1.0, 1.0], seed=seed)
    heights = ground.tiles[0].heights.astype(float)
    n = len(heights)
    inside = np.abs((np.arange(n) + 0.5) * 12 / n - 6 if part.boxes else np.linspace(-6, 6, n)) <= 6 - rim + 1e-9
    return heights[np.ix_(inside, inside)]


@pytest.mark.parametrize("boxes", [False, True])
@pytest.mark.parametrize("name", PARTS)
def test_the_width_of_the_rim_changes_no_moment(name: str, boxes: bool):
    kind, options, deviation = PARTS[name]
    for rim in RIMS:
        tiles = [kind(proportion=1, boxes=boxes, **options) for _ in range(3)]
        found = [inner_heights(tile, 0.1, rim * 0.1, seed) for seed, tile in enumerate(tiles)]
        assert np.std(found) == pytest.approx(deviation, rel=0.06)
        assert np.mean(found) == pytest.approx(0.0, abs=0.1 * A)
        assert np.abs(found).max() <= A + 1e-6


def test_between_drawn_points_noise_is_linear():
    noise = UniformNoise(proportion=1, amplitude_range=[0.1, 0.1], downsampled_scale=0.4, platform_width=0.2)
    found = noise.heights(0.0, CORNERS, rng())
    outside = np.diff(found[:, 0], n=2)
    assert np.abs(outside[[0, 1, 2, 4, 5, 6]]).max() < 1e-12
    assert np.abs(outside[[3, 7]]).min() > 1e-4
    assert (found[9:12, 9:12] == 0).all()


def test_squares_of_a_grid_are_level_and_grow():
    squares = RandomGrid(proportion=1, grid_width=0.4, grid_height_range=[0.1, 0.5], platform_width=0.4)
    found = squares.heights(1.0, CELLS, rng()).reshape(5, 4, 5, 4)
    assert (np.ptp(found, axis=(1, 3)).max(), found[2, 0, 2, 0]) == (0, 0)
    assert 0.3 < np.abs(found).max() <= 0.5
    assert np.allclose(squares.heights(0.0, CELLS, rng()), found.reshape(20, 20) / 5)


def test_obstacles_have_their_heights_and_leave_the_middle_free():
    sizes = {"obstacle_width_range": [0.3, 0.6], "obstacle_height_range": [0, 0.2], "platform_width": 0.6}
    obstacles = DiscreteObstacles(proportion=1, num_obstacles=30, **sizes)
    found = obstacles.heights(1.0, CELLS, rng())
    assert set(np.unique(found)) == {-0.2, -0.1, 0.0, 0.1, 0.2}
    assert not found[7:13, 7:13].any()
    obstacles.obstacle_height_mode = "fixed"
    assert set(np.unique(obstacles.heights(0.5, CELLS, rng()))) == {0.0, 0.1}


def test_stones_have_their_width_and_distance():
    sizes = {"stone_width_range": [0.2, 0.4], "stone_distance_range": [0.0, 0.1], "platform_width": 0.4}
    stones = SteppingStones(proportion=1, stone_height_max=0.05, holes_depth=-1.0, **sizes)
    fine = grid((2.0, 2.0), 0.01, boxes=True)
    easy, hard = stones.heights(0.0, fine, rng()), stones.heights(1.0, fine, rng())
    assert easy.min() >= -0.05  # Stones without a distance have no holes between them.
    # Stones of 0.2 m are 0.1 m apart, along rows and between rows.
    between = [k for start in range(20, 200, 30) for k in range(start, start + 10)]
    assert np.flatnonzero((hard[:80] == -1).all(axis=0)).tolist() == between
    assert set(np.diff(np.flatnonzero(np.diff((hard[:, 5] == -1).astype(int)))).tolist()) == {10, 20}
    assert not hard[81:119, 81:119].any()


def test_a_gap_lies_around_the_platform():
    gap = Gap(proportion=1, gap_width_range=[0.1, 0.3], gap_depth=0.5, platform_width=0.8)
    level, down = [0.0], [-0.5]
    assert profile(gap.heights(0.5, CELLS, rng())) == level * 4 + down * 2 + level * 8 + down * 2 + level * 4


def test_rails_are_placed_like_isaac_labs():
    rails = Rails(proportion=1, rail_thickness_range=[0.1, 0.2], rail_height_range=[0.1, 0.3], platform_width=0.8)
    # The inner edge of the outer rail is at 0.8 + 0.6 * (2 - 0.8) = 1.52 m.
    half = [0, 0.2, 0.2, 0, 0, 0.2, 0, 0, 0, 0]
    found = profile(rails.heights(0.5, CELLS, rng()))
    assert (found[3:17], found[1]) == (pytest.approx((half + half[::-1])[3:17]), 0.2)


def test_boxes_and_pits_have_one_step_or_two():
    box = Box(proportion=1, box_height_range=[0.1, 0.3], platform_width=0.4)
    assert profile(box.heights(0.0, CELLS, rng())) == [0] * 8 + [0.1] * 4 + [0] * 8
    box.double_box = True  # The edge of the lower step is 0.4 + 0.6 * 1.6 = 1.36 m.
    assert profile(box.heights(0.5, CELLS, rng())) == [0] * 3 + [0.2] * 5 + [0.4] * 4 + [0.2] * 5 + [0] * 3
    pit = Box(proportion=1, box_height_range=[0.1, 0.3], platform_width=0.4, double_box=True, inverted=True)
    assert np.array_equal(pit.heights(0.5, CELLS, rng()), -box.heights(0.5, CELLS, rng()))
