import math

import pytest
import torch

from wheelleg_exp.sim.sensors import BpearlPattern, GridPattern, LidarPattern, PinholePattern

CPU = torch.device("cpu")


def test_a_grid_runs_through_x_or_through_y_first_and_has_both_ends():
    x_first, directions = GridPattern(0.5, [1.0, 0.5]).rays(CPU)
    assert x_first.tolist() == [[x, y, 0.0] for y in (-0.25, 0.25) for x in (-0.5, 0.0, 0.5)]
    assert directions.tolist() == [[0.0, 0.0, -1.0]] * 6
    y_first, directions = GridPattern(0.5, [1.0, 0.5], direction=[1.0, 0.0, 0.0], ordering="yx").rays(CPU)
    assert y_first.tolist() == [[x, y, 0.0] for x in (-0.5, 0.0, 0.5) for y in (-0.25, 0.25)]
    assert directions.tolist() == [[1.0, 0.0, 0.0]] * 6
    # Isaac Lab's height scanner for rough terrain has this grid. Its step has no binary fraction.
    starts, _ = GridPattern(0.1, [1.6, 1.0]).rays(CPU)
    assert (len(starts), starts[:, :2].amax(dim=0).tolist()) == (17 * 11, pytest.approx([0.8, 0.5]))


def test_a_lidar_has_its_beams_from_below_and_leaves_out_the_last_angle_of_a_turn():
    third = math.pi / 6
    starts, directions = LidarPattern(2, [-third, third], [0.0, 2 * math.pi], math.pi / 2).rays(CPU)
    level, up = math.cos(third), math.sin(third)
    expected = [[level * x, level * y, z] for z in (-up, up) for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    torch.testing.assert_close(directions, torch.tensor(expected))
    assert not starts.any()
    turned = [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    for half, expected in ((math.pi, turned), (math.pi / 2, turned[1:])):
        _, directions = LidarPattern(1, [0.0, 0.0], [-half, half], math.pi / 2).rays(CPU)
        torch.testing.assert_close(directions, torch.tensor(expected))
    _, directions = LidarPattern(1, [0.0, 0.0], [0.0, 1.0], 0.3).rays(CPU)
    assert len(directions) == 5  # The gaps are at most the resolution. Five rays have four gaps of 0.25.
    assert float(torch.atan2(directions[1, 1], directions[1, 0])) == pytest.approx(0.25)


def test_the_bpearl_has_the_32_beams_of_the_device():
    _, directions = BpearlPattern().rays(CPU)
    assert directions.shape == (36 * 32, 3)
    angles = torch.rad2deg(torch.asin(directions[:32, 2]))
    assert angles[[0, 1, 24, 31]].tolist() == pytest.approx([89.5, 86.6875, 22.0, 2.3125])
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(36 * 32))
    azimuths = torch.atan2(directions[::32, 1], directions[::32, 0])[:3]
    torch.testing.assert_close(azimuths, torch.deg2rad(10.0 * torch.arange(3)))


def test_a_part_of_a_bpearl_looks_backwards():
    _, directions = BpearlPattern(math.pi / 2, math.pi / 4, [0.0, math.pi / 6]).rays(CPU)
    half, level = math.sqrt(0.5), math.cos(math.pi / 6)
    level_ones = torch.tensor([[-half, half, 0.0], [-1.0, 0.0, 0.0]])
    torch.testing.assert_close(directions[::2], level_ones)
    torch.testing.assert_close(directions[1::2], level * level_ones + torch.tensor([0.0, 0.0, 0.5]))


def test_a_pinhole_looks_along_x_row_by_row_from_the_upper_left():
    pattern = PinholePattern(width=4, height=2, focal_length=3.0, horizontal_aperture=6.0)
    _, directions = pattern.rays(CPU)
    through = directions / directions[:, :1]
    expected = [[1.0, -u, -v] for v in (-0.25, 0.25) for u in (-0.75, -0.25, 0.25, 0.75)]
    torch.testing.assert_close(through, torch.tensor(expected))
    assert pattern.intrinsics == ((2.0, 0.0, 2.0), (0.0, 2.0, 1.0), (0.0, 0.0, 1.0))


def test_a_pinholes_centre_can_differ_from_the_images():
    pattern = PinholePattern(4, 2, 1.0, 2.0, horizontal_aperture_offset=0.25, vertical_aperture_offset=-0.25)
    assert [row[2] for row in pattern.intrinsics] == [2.5, 0.5, 1.0]
    _, directions = pattern.rays(CPU)
    torch.testing.assert_close((directions / directions[:, :1])[2], torch.tensor([1.0, 0.0, -0.0]))
