import gc
import math
import subprocess

import pytest
import torch

from sim.sensors.grounds import STEP
from sim.small_envs import run
from wheelleg_exp.rendering import renderer
from wheelleg_exp.rendering.renderer import NoGraphics
from wheelleg_exp.sim import rotation

pytestmark = [pytest.mark.pictures, pytest.mark.usefixtures("allow_test_terms", "graphics")]
HALF = math.sqrt(0.5)
DOWN = [HALF, 0.0, HALF, 0.0]  # A rotation by 90 degrees about y points the x axis down.
BELOW = {"pos": [0.0, 0.0, -0.2], "rot": DOWN, "convention": "world"}
ALL = torch.arange(2)


@pytest.fixture
def make(start_env):
    def build(ground=None, base="block", body="block", **settings):
        node = {"_target_": "wheelleg_exp.sim.sensors.Camera", "body_name": body, "width": 40, "height": 30}
        scene = {"sensors": {"eye": {**node, "offset": BELOW, **settings}}}
        scene |= {} if ground is None else {"terrain": ground}
        return start_env(base, num_envs=2, scene=scene, sim={"gravity": [0.0, 0.0, 0.0]})

    return build


def place(env, pos, roll=0.0, pitch=0.0, yaw=0.0, ids=ALL):
    quat = rotation.quat_from_euler_xyz(*(torch.full((len(ids),), float(angle)) for angle in (roll, pitch, yaw)))
    env.scene.robot.write_root_pose_to_sim(torch.cat((torch.tensor(pos).expand(len(ids), 3), quat), dim=1), ids)
    env.scene.refresh()
    return env.scene["eye"].data


def points(data, kind):
    height, width = data.image_shape
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack((u, v, torch.ones_like(u)), dim=-1)
    rays = torch.einsum("nij,hwj->nhwi", torch.linalg.inv(data.intrinsic_matrices), pixels)
    if kind == "distance_to_camera":
        rays = rays / rays.norm(dim=-1, keepdim=True)
    turn = rotation.quat_to_matrix(data.quat_w_ros)
    return data.pos_w.view(-1, 1, 1, 3) + torch.einsum("nij,nhwj->nhwi", turn, rays * data.output[kind])


def test_each_pixel_shows_a_point_of_its_surface(make):
    optics = {"focal_length": 20.0, "horizontal_aperture": 30.0, "vertical_aperture": 40.0}
    shift = {"horizontal_aperture_offset": 0.15, "vertical_aperture_offset": -0.1}
    kinds = ["distance_to_image_plane", "distance_to_camera"]
    env = make(STEP, data_types=[*kinds, "instance_id_segmentation_fast"], **optics, **shift)
    data = place(env, [3.8, 0.6, 1.6], roll=0.1, pitch=0.1, yaw=0.4)
    number = {name: key for key, name in data.info["instance_id_segmentation_fast"]["idToLabels"].items()}
    geom = data.output["instance_id_segmentation_fast"][..., 0]
    for seen in (points(data, kind) for kind in kinds):
        low, step = seen[geom == number["ground"]], seen[geom == number["ground/step"]]
        assert min(len(low), len(step)) > 300
        torch.testing.assert_close(low[:, 2], torch.zeros(len(low)), atol=1e-3, rtol=0)
        assert torch.stack((4.0 - low[:, 0], low[:, 1] - 1.0)).amax(dim=0).min() > -1e-3
        is_top = (step[:, 2] - 0.25).abs() < 1e-3
        top, side = step[is_top], step[~is_top]
        assert len(top) > 200
        assert len(side) > 10
        assert top[:, 0].min() > 3.999
        assert top[:, 1].max() < 1.001
        assert torch.stack(((side[:, 0] - 4.0).abs(), (side[:, 1] - 1.0).abs())).amin(dim=0).max() < 1e-3


@pytest.mark.parametrize(
    ("convention", "rot"),
    [
        ("world", DOWN),
        ("opengl", [HALF, 0.0, 0.0, -HALF]),
        ("ros", [0.0, HALF, -HALF, 0.0]),
    ],
)
def test_one_camera_in_three_conventions(make, convention, rot):
    kinds = ["distance_to_image_plane", "instance_id_segmentation_fast"]
    env = make(STEP, data_types=kinds, offset={**BELOW, "rot": rot, "convention": convention})
    data = place(env, [4.1, 0.8, 1.5], yaw=0.3)
    for name, axis, sign in (("world", 0, 1.0), ("ros", 2, 1.0), ("opengl", 2, -1.0)):
        forward = sign * rotation.quat_to_matrix(getattr(data, f"quat_w_{name}"))[:, :, axis]
        torch.testing.assert_close(forward, torch.tensor([[0.0, 0.0, -1.0]] * 2), atol=1e-6, rtol=0)
    torch.testing.assert_close(data.pos_w, torch.tensor([[4.1, 0.8, 1.3]] * 2))
    right = rotation.quat_to_matrix(data.quat_w_ros)[:, :, 0]
    torch.testing.assert_close(right, torch.tensor([[math.sin(0.3), -math.cos(0.3), 0.0]] * 2), atol=1e-6, rtol=0)
    seen = points(data, kinds[0])
    on_step = data.output[kinds[1]][..., 0] == data.output[kinds[1]].max()
    assert on_step.sum() > 200
    torch.testing.assert_close(seen[on_step][:, 2], torch.full((int(on_step.sum()),), 0.25), atol=1e-3, rtol=0)


def test_a_surface_facing_the_camera_has_the_colour_of_its_material(make):
    data = place(make(data_types=["rgb", "rgba"], fovy=0.3), [0.0, 0.0, 1.0])
    plane = torch.tensor([0.35, 0.38, 0.42]) * 255.0
    assert (data.output["rgb"].dtype, data.output["rgb"].shape) == (torch.uint8, (2, 30, 40, 3))
    torch.testing.assert_close(data.output["rgb"][0, 15, 20].float(), plane, atol=3.0, rtol=0)
    assert torch.equal(data.output["rgba"][..., :3], data.output["rgb"])
    assert (data.output["rgba"][..., 3] == 255).all()


@pytest.mark.parametrize(("behavior", "beyond"), [("none", math.inf), ("zero", 0.0), ("max", 5.0)])
def test_distances_beyond_the_range_follow_the_clipping_behavior(make, behavior, beyond):
    settings = {"fovy": 0.9, "clipping_range": [0.05, 5.0], "depth_clipping_behavior": behavior}
    settings |= {"data_types": ["distance_to_image_plane", "distance_to_camera", "semantic_segmentation"]}
    data = place(make(offset={"pos": [0.3, 0.0, 0.0], "convention": "world"}, **settings), [0.0, 0.0, 1.0])
    down = (torch.arange(30) - 14.5) / (15 / math.tan(0.45))
    seen = 1.0 / down < 5.0
    depth = data.output["distance_to_image_plane"][0, :, 20, 0]
    is_ground = (down > 0.0) & seen
    torch.testing.assert_close(depth[is_ground], 1.0 / down[is_ground], atol=0, rtol=1e-4)
    assert (depth[~is_ground] == beyond).all()
    far = data.output["distance_to_camera"][0, :, 20, 0][~is_ground]
    assert (far == beyond).all() if behavior != "max" else (far >= 5.0).all()
    assert (data.output["semantic_segmentation"][0, :, 20, 0] == is_ground).all()


def test_a_picture_shows_its_own_robot_alone_whatever_was_drawn_before(make):
    up = {"pos": [-0.6, 0.0, 0.3], "rot": [0.97, 0.0, 0.243, 0.0], "convention": "world"}
    kinds = ["rgb", "depth", "semantic_segmentation", "instance_segmentation_fast"]
    env = make(base="rover", body="base", offset=up, data_types=kinds)
    first = {kind: value.clone() for kind, value in place(env, [0.0, 0.0, 0.3]).output.items()}
    assert {1, 2} <= set(first["semantic_segmentation"].unique().tolist())
    names = env.scene["eye"].data.info["instance_segmentation_fast"]["idToLabels"]
    found = {names[key] for key in first["instance_segmentation_fast"].unique().tolist()}
    assert {"base", "left_wheel", "right_wheel"} <= found
    assert all(torch.equal(value[0], value[1]) for value in first.values())  # Both robots have the same pose.
    other = place(env, [40.0, 9.0, 0.5], roll=0.4, ids=ALL[:1])
    assert not torch.equal(other.output["rgb"][0], first["rgb"][0])
    assert all(torch.equal(other.output[kind][1], first[kind][1]) for kind in kinds)
    again = place(env, [0.0, 0.0, 0.3])
    assert all(torch.equal(again.output[kind], first[kind]) for kind in kinds)


def test_with_a_period_the_last_image_is_held_and_continues_from_its_state(make):
    env, other = (make(update_period=0.03, data_types=["rgb", "depth"]) for _ in range(2))
    data = place(env, [0.0, 0.0, 1.0])
    run(env)  # The reset takes the episode's first picture.
    held = data.output["depth"].clone()
    run(env)
    new = env.scene["eye"].data.output["depth"].clone()
    assert not torch.equal(held, new)
    other.load_state_dict(env.state_dict())
    assert torch.equal(other.scene["eye"].data.output["depth"], new)
    for each in (env, other):
        run(each)
    assert torch.equal(other.scene["eye"].data.output["depth"], env.scene["eye"].data.output["depth"])


def test_its_process_ends_with_it(make, monkeypatch):
    started, real = [], subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(real(*a, **k)) or started[-1])
    env = make()
    place(env, [0.0, 0.0, 1.0])
    assert len(started) == 1
    del env
    gc.collect()
    assert started[0].poll() == 0


def test_without_graphics_the_error_names_the_sensor(make, monkeypatch):
    monkeypatch.setattr(renderer, "BACKENDS", ("glfw",))  # no display here
    env = make()
    with pytest.raises(NoGraphics, match=r"env\.scene\.sensors\.eye: drawing is not possible.*libegl1"):
        place(env, [0.0, 0.0, 1.0])
