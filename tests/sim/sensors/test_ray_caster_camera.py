import math

import pytest
import torch

from sim.sensors.grounds import STEP
from wheelleg_exp.sim import rotation

pytestmark = pytest.mark.usefixtures("allow_test_terms")
PREFIX = "wheelleg_exp.sim.sensors."
HALF = math.sqrt(0.5)
OPTICS = {"width": 20, "height": 16, "focal_length": 20.0, "horizontal_aperture": 30.0, "vertical_aperture": 28.0}
OPTICS |= {"horizontal_aperture_offset": 0.1, "vertical_aperture_offset": -0.05}
# The camera looks along the body's -z axis, and its axis to the right is the body's -y axis.
OFFSET = {"pos": [0.05, 0.0, -0.2], "rot": [0.0, HALF, -HALF, 0.0], "convention": "ros"}
KINDS = ["distance_to_image_plane", "distance_to_camera"]


@pytest.fixture
def make(start_env):
    def build(ground=None, drawn=None, **settings):
        pattern = {"_target_": PREFIX + "PinholePattern", **OPTICS}
        node = {"body_name": "block", "offset": OFFSET, "data_types": KINDS}
        sensors = {"eye": {"_target_": PREFIX + "RayCasterCamera", "pattern": pattern, **node, **settings}}
        if drawn:
            sensors["drawn"] = {"_target_": PREFIX + "Camera", **node, **OPTICS}
        scene = {"sensors": sensors} | ({} if ground is None else {"terrain": ground})
        return start_env("block", num_envs=2, scene=scene, sim={"gravity": [0.0, 0.0, 0.0]})

    return build


def place(env, pos, roll=0.0, pitch=0.0, yaw=0.0):
    angles = (torch.full((2,), float(angle)) for angle in (roll, pitch, yaw))
    env.scene.robot.write_root_pose_to_sim(torch.cat((torch.tensor(pos), rotation.quat_from_euler_xyz(*angles)), dim=1))
    env.scene.refresh()
    return env.scene["eye"].data


def test_distances_to_a_plane_are_those_of_its_formula(make):
    data = place(make(), [[0.0, 0.0, 1.0], [5.0, 2.0, 0.6]], roll=0.2, pitch=-0.3, yaw=1.0)
    f_x, f_y = 20 * 20.0 / 30.0, 16 * 20.0 / 28.0
    v, u = torch.meshgrid(torch.arange(16) + 0.5, torch.arange(20) + 0.5, indexing="ij")
    right, down = (u - 10 - 0.1 * f_x) / f_x, (v - 8 + 0.05 * f_y) / f_y
    ahead = torch.stack((-down, -right, -torch.ones_like(u)), dim=-1)
    c, s = math.cos, math.sin
    # This is the last row of the matrix Rz Ry Rx.
    lowest = torch.tensor([-s(-0.3), c(-0.3) * s(0.2), c(-0.3) * c(0.2)])
    for env, height in enumerate((1.0, 0.6)):
        along = (-(height + lowest @ torch.tensor([0.05, 0.0, -0.2])) / (ahead @ lowest)).unsqueeze(-1)
        torch.testing.assert_close(data.output["distance_to_image_plane"][env], along, atol=1e-5, rtol=1e-5)
        ray = along * ahead.norm(dim=-1, keepdim=True)
        torch.testing.assert_close(data.output["distance_to_camera"][env], ray, atol=1e-5, rtol=1e-5)
    expected = torch.tensor([[f_x, 0.0, 10 + 0.1 * f_x], [0.0, f_y, 8 - 0.05 * f_y], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(data.intrinsic_matrices, expected.expand(2, 3, 3))


@pytest.mark.pictures
@pytest.mark.usefixtures("graphics")
def test_it_measures_the_distances_that_mujoco_draws(make):
    env = make(STEP, drawn=True, max_distance=20.0)
    by_rays = place(env, [[3.9, 0.4, 1.5], [5.8, -0.8, 0.9]], roll=0.15, pitch=-0.1, yaw=0.7)
    drawn = env.scene["drawn"].data
    for name in ("pos_w", "quat_w_world", "quat_w_ros", "quat_w_opengl", "intrinsic_matrices"):
        torch.testing.assert_close(getattr(by_rays, name), getattr(drawn, name))
    assert by_rays.image_shape == drawn.image_shape == (16, 20)
    for kind in KINDS:
        one, other = by_rays.output[kind], drawn.output[kind]
        assert torch.isclose(one, other, atol=2e-3, rtol=0).float().mean() > 0.98, kind
        assert one.max() - one.min() > 0.2


@pytest.mark.parametrize(("behavior", "beyond"), [("none", math.inf), ("zero", 0.0), ("max", 1.2)])
def test_distances_beyond_the_farthest_follow_the_clipping_behavior(make, behavior, beyond):
    level = {"pos": [0.3, 0.0, 0.0], "convention": "world"}
    data = place(make(offset=level, max_distance=1.2, depth_clipping_behavior=behavior), [[0.0, 0.0, 0.5]] * 2)
    down = (torch.arange(16) + 0.5 - 8 + 0.05 * 80 / 7) / (80 / 7)
    along = torch.where(down > 0, 0.5 / down, math.inf)
    seen = along <= 1.2
    depth = data.output["distance_to_image_plane"][1, :, 3, 0]
    torch.testing.assert_close(depth[seen], along[seen], atol=1e-5, rtol=1e-5)
    assert seen.sum() == 4
    assert (depth[~seen] == beyond).all()


def test_the_robot_is_invisible(make):
    inside = {"pos": [0.0, 0.0, 0.0], "rot": OFFSET["rot"], "convention": "ros"}
    data = place(make(offset=inside), [[0.0, 0.0, 1.0]] * 2)
    torch.testing.assert_close(data.output["distance_to_image_plane"], torch.ones(2, 16, 20, 1))
