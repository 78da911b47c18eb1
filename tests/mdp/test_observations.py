"""Every observation term, compared with values computed by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from mdp.fakes import entity, fake_env
from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.mdp import observations
from wheelleg_exp.sim import rotation

T = torch.tensor

BODY_QUATS = T([[[1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.8, 0.0]], [[1.0, 0.0, 0.0, 0.0]] * 2])
LEGS = SimpleNamespace(raw_actions=T([[7.0]]))
ENV = fake_env(
    env_origins=T([[1.0, 2.0, 0.0], [0.0, 0.0, 0.5]]),
    data_root_pos_w=T([[1.5, 2.0, 0.3], [0.0, 1.0, 0.75]]),
    data_root_quat_w=T([[-0.6, 0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
    data_joint_acc=T([[7.0, 8.0, 9.0], [0.0, 0.0, 0.0]]),
    data_root_rot_w=rotation.quat_to_matrix(BODY_QUATS[0]),
    data_projected_gravity_b=T([[0.0, 0.0, -1.0], [0.96, 0.0, 0.28]]),
    data_body_pos_w=T([[[0.0] * 3, [2.0, 4.0, 3.0]], [[0.0] * 3, [1.0, 1.0, 1.0]]]),
    data_body_quat_w=BODY_QUATS,
    data_body_rot_w=rotation.quat_to_matrix(BODY_QUATS.view(4, 4)).view(2, 2, 3, 3),
    data_joint_pos=T([[0.5, 1.0, 3.0], [0.0, 0.0, 0.0]]),
    data_default_joint_pos=T([[0.25, 1.0, 0.0], [0.1, 0.0, 0.0]]),
    data_joint_vel=T([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]),
    data_default_joint_vel=T([[0.5, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    data_soft_joint_pos_limits=T(2 * [[[-0.5, 1.5], [-1.0, 1.0], [0.0, 4.0]]]),
    data_applied_torque=T([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
    episode_length_buf=T([0, 50]),
    step_dt=0.02,
    max_episode_length_s=5.0,
    commands={"v": T([[1.0, 2.0]]), "p": T([[3.0]])},
    action_manager=SimpleNamespace(action=T([[1.0, 2.0]]), get_term={"legs": LEGS}.__getitem__),
)


def close(got, expected):
    torch.testing.assert_close(got, T(expected), atol=1e-6, rtol=1e-6)


FIRST, SECOND = entity(joints=[0]), entity(bodies=[1])
POSES = [[1.0, 2.0, 3.0, 0.6, 0.0, 0.8, 0.0], [1.0, 1.0, 0.5, 1.0, 0.0, 0.0, 0.0]]  # from the environments' origins
ANGLES = [[math.sin(0.5), math.sin(3), math.cos(0.5), math.cos(3)], [0.0, 0.0, 1.0, 1.0]]


@pytest.mark.parametrize(
    ("name", "fields", "expected"),
    [
        ("base_pos_z", {}, [[0.3], [0.75]]),  # in the world
        ("root_pos_w", {}, [[0.5, 0.0, 0.3], [0.0, 1.0, 0.25]]),  # from the environment's origin
        ("root_quat_w", {}, [[-0.6, 0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
        ("root_quat_w", {"make_quat_unique": True}, [[0.6, -0.8, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]),
        ("joint_pos", {"asset_cfg": FIRST}, [[0.5], [0.0]]),
        ("joint_pos_rel", {}, [[0.25, 0.0, 3.0], [-0.1, 0.0, 0.0]]),
        ("joint_vel", {"asset_cfg": FIRST}, [[1.0], [0.0]]),
        ("joint_vel_rel", {}, [[0.5, 2.0, 3.0], [0.0, 0.0, -1.0]]),
        ("joint_effort", {"asset_cfg": entity(joints=[2, 0])}, [[3.0, 1.0], [6.0, 4.0]]),
        ("joint_pos_sin_cos", {"asset_cfg": entity(joints=[0, 2])}, ANGLES),
        ("joint_acc", {"asset_cfg": FIRST}, [[7.0], [0.0]]),
        ("body_pose_w", {"asset_cfg": SECOND}, POSES),
        ("body_projected_gravity_b", {"asset_cfg": SECOND}, [[0.96, 0.0, 0.28], [0.0, 0.0, -1.0]]),
        ("current_time_s", {}, [[0.0], [1.0]]),
        ("remaining_time_s", {}, [[5.0], [4.0]]),
        ("last_action", {}, [[1.0, 2.0]]),
        ("last_action", {"action_name": "legs"}, [[7.0]]),
        ("generated_commands", {"command_name": "p"}, [[3.0]]),
        ("generated_commands", {"command_name": "v"}, [[1.0, 2.0]]),
    ],
)
def test_a_formula_by_hand(name, fields, expected):
    close(getattr(observations, name)(ENV, **fields), expected)


def test_positions_between_their_limits():
    close(observations.joint_pos_limit_normalized(ENV)(ENV), [[0.0, 1.0, 0.5], [-0.5, 0.0, -1.0]])


def test_velocities_are_those_of_the_robot():
    names = {name: f"root_{name.removeprefix('base_')}_b" for name in ("base_lin_vel", "base_ang_vel")}
    names |= {"root_link_lin_vel": "root_link_lin_vel_b", "projected_gravity": "projected_gravity_b"}
    names |= {name: name for name in ("root_lin_vel_w", "root_ang_vel_w")}
    env = fake_env(**{f"data_{name}": torch.full((2, 3), float(i)) for i, name in enumerate(names.values())})
    for k, name in enumerate(names):
        assert (getattr(observations, name)(env) == k).all(), name


def test_an_unlimited_joint_has_no_position_between_limits(make_env):
    node = {"_target_": "wheelleg_exp.mdp.observations.joint_pos_limit_normalized"}
    with pytest.raises(WheellegError, match=r"left_axle|limit"):
        make_env(observations={"policy": {"terms": {"x": node}}})


def test_heights_and_tilts_of_the_base():
    root = [[0.0, 0.0, 0.5], [2.0, 3.0, 0.5]]
    gravity = [[math.sin(0.3), 0.0, -math.cos(0.3)], [0.0, -math.sin(-2.0), -math.cos(-2.0)]]  # pitch .3, roll -2
    env = fake_env(data_root_pos_w=T(root), data_projected_gravity_b=T(gravity))
    env.scene.terrain = SimpleNamespace(height_at=lambda xy: 0.1 * xy[:, 0] + 0.01 * xy[:, 1])
    rounded = fake_env(data_projected_gravity_b=T([[1.0000001, 0.0, -0.0]]))
    close(observations.base_roll_pitch(rounded)[:, 1:], [[math.pi / 2]])
    close(observations.base_height(env), [[0.5], [0.27]])
    close(observations.base_roll_pitch(env), [[0.0, 0.3], [-2.0, 0.0]])


def test_a_gait_clock_repeats_with_its_period():
    """With steps of .02 s and a period of .16 s, the steps 0, 3, and 10 are at 0, 3/8, and 10/8 of a cycle."""
    env = fake_env(episode_length_buf=T([0, 3, 10]), step_dt=0.02)
    half = math.sqrt(0.5)
    expected = [[0.0, 1.0, 1.0, 0.0], [half, -half, -half, -half], [1.0, 0.0, 0.0, -1.0]]
    close(observations.gait_phase(env, period=0.16, offsets=[0.0, 0.25]), expected)
    close(observations.gait_phase(env, period=0.16), [[row[0], row[2]] for row in expected])


def test_a_height_scan_is_from_the_sensor_to_the_ground_and_a_miss_is_cut_by_the_clip():
    data = SimpleNamespace(pos_w=T([[5.0, 6.0, 1.0]]), ray_hits_w=T([[[0.0, 0.0, 0.25], [9.0, 9.0, math.inf]]]))
    env = SimpleNamespace(scene={"scanner": SimpleNamespace(data=data)})
    close(observations.height_scan(env, sensor_cfg=entity("scanner"), offset=0.5), [[0.25, -math.inf]])
    close(observations.height_scan(env, sensor_cfg=entity("scanner")).clip(-1.0, 1.0), [[0.25, -1.0]])


def test_an_imus_measurements_are_observed():
    names = {"orientation": "quat_w", "projected_gravity": "projected_gravity_b", "ang_vel": "ang_vel_b"}
    names |= {"lin_acc": "lin_acc_b"}
    data = SimpleNamespace(**{measured: T([[float(k)]]) for k, measured in enumerate(names.values())})
    env = SimpleNamespace(scene={"imu": SimpleNamespace(data=data)})
    assert [getattr(observations, f"imu_{name}")(env).item() for name in names] == [0.0, 1.0, 2.0, 3.0]


def test_contacts_of_bodies_as_flags_forces_and_times():
    env = fake_env(contact_norm=T([[0.2, 0.4, 3.0]]))
    chosen = entity("contact", bodies=[2, 0])
    close(observations.body_contacts(env, sensor_cfg=chosen, threshold=0.3), [[1.0, 0.0]])
    close(observations.body_contacts(env, sensor_cfg=chosen, threshold=3.0), [[0.0, 0.0]])
    env.scene["contact"].data = SimpleNamespace(
        net_forces_w=T([[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]]), current_air_time=T([[0.1, 0.2, 0.3]])
    )
    close(observations.body_contact_forces(env, sensor_cfg=chosen), [[7.0, 8.0, 9.0, 1.0, 2.0, 3.0]])
    close(observations.body_air_time(env, sensor_cfg=chosen), [[0.3, 0.1]])


def _camera(intrinsics=None, **output):
    data = SimpleNamespace(output=output, intrinsic_matrices=intrinsics)
    return SimpleNamespace(scene={"eye": SimpleNamespace(data=data)})


def test_images_are_normalised_by_their_type():
    rgb = T([[[[0, 51, 255], [255, 51, 0]]]], dtype=torch.uint8)
    far = T([[[[1.5], [math.inf]]]])
    env = _camera(rgb=rgb, depth=far, normals=T([[[[-1.0, 0.0, 1.0]]]]))
    eye = entity("eye")
    close(observations.image(env, sensor_cfg=eye), [[[[-0.5, 0.0, 0.5], [0.5, 0.0, -0.5]]]])
    close(observations.image(env, sensor_cfg=eye, normalize=False), rgb.float().tolist())
    close(observations.image(env, sensor_cfg=eye, data_type="depth"), [[[[1.5], [0.0]]]])
    close(observations.image(env, sensor_cfg=eye, data_type="depth", normalize=False), far.tolist())
    close(observations.image(env, sensor_cfg=eye, data_type="normals"), [[[[0.0, 0.5, 1.0]]]])
    assert rgb.tolist() == [[[[0, 51, 255], [255, 51, 0]]]]


def test_a_missing_image_type_is_rejected_with_the_existing_types():
    env = _camera(depth=T([[[[1.0]]]]), rgba=T([[[[1.0]]]]))
    with pytest.raises(ConfigError) as raised:
        observations.image(env, sensor_cfg=entity("eye"))
    assert (raised.value.key, raised.value.expected) == ("data_type", "one of depth, rgba")


def test_distances_can_be_converted_to_those_along_the_axis():
    """The camera with f = 2 px and 4 px about pixel (1, 0.5) sees a wall at 2 m."""
    columns, rows = T([-0.5, 0.0, 0.5]), T([-0.125, 0.125])
    slant = torch.sqrt(1 + columns.view(1, 3) ** 2 + rows.view(2, 1) ** 2)
    intrinsics = T([[[2.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]]])
    env = _camera(intrinsics, distance_to_camera=2.0 * slant.view(1, 2, 3, 1))
    settings = {"data_type": "distance_to_camera", "convert_perspective_to_orthogonal": True}
    close(observations.image(env, sensor_cfg=entity("eye"), **settings), torch.full((1, 2, 3, 1), 2.0).tolist())
