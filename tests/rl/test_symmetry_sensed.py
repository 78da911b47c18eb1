"""Test mirror images of sensors, bodies, clocks, and commands against the physics and hand-computed values."""

import math

import pytest
import torch

from .test_symmetry import CALM, MIRRORED, check_mirror, write_twins

HALF = 16
CRITIC = "env.observations.critic"
SEEN = ["body_pose", "body_projected_gravity"]
SEEN += [f"sensors/imu_{name}" for name in ("ang_vel", "lin_acc", "orientation", "projected_gravity")]
SEEN += [f"sensors/wheel_{name}" for name in ("air_time", "contact_forces", "contacts")]
IMU = "env.scene.sensors.imu"
IMU_OFFSET = f"{IMU}.offset={{pos: [0.01, 0.0, 0.02], rot: [0.96, 0.0, 0.28, 0.0]}}"
WORDS = [MIRRORED, *CALM, "env.num_envs=32", f"{CRITIC}.history_length=2"]
WORDS += ["+sensor@env.scene.sensors=[height_scanner,imu]", "env.scene.sensors.contact_forces.track_air_time=true"]
WORDS += ["command@env.commands=[base_velocity,base_pose,place]", IMU_OFFSET]
WORDS += [f"{IMU}.{sensor}=null" for sensor in ("accelerometer", "gyroscope")]


def shown(command):
    function = "{_target_: wheelleg_exp.mdp.observations.generated_commands, command_name: " + command + "}"
    return f"+{CRITIC}.terms.{command}_command={function}"


def seen(*options):
    return f"observation@{CRITIC}.terms=[{','.join(options)}]"


@pytest.fixture(scope="module")
def adapter(make_trainer):
    times = [f"env.commands.{name}.resampling_time_range=[9,9]" for name in ("base_velocity", "base_pose", "place")]
    commands = [shown("base_pose"), shown("place"), "env.commands.base_velocity.rel_standing_envs=0.0"]
    return make_trainer(*WORDS, *times, seen(*SEEN), *commands).env


def both(values, *signs):
    return torch.cat((values, values * torch.tensor([float(sign) for sign in signs])))


def write_commands(env):
    """Set the commands of environments 16-31 to the mirror images of the commands of environments 0-15."""
    generator = torch.Generator().manual_seed(3)
    pose, place = (env.command_manager.get_term(name) for name in ("base_pose", "place"))
    pose.command[:] = both(torch.rand(HALF, 3, generator=generator), 1, -1, 1)
    place.pos_command_w[:] = env.scene.env_origins + both(torch.rand(HALF, 3, generator=generator), 1, -1, 1)
    heading = 2.0 * torch.rand(HALF, generator=generator) - 1.0
    place.heading_command_w[:] = torch.cat((heading, -heading))


def test_what_an_image_senses_is_the_image_of_what_is_sensed(adapter):
    env = adapter.env
    write_twins(env)
    write_commands(env)
    generator, touched = torch.Generator().manual_seed(7), 0.0
    for step in range(12):
        one = 2.0 * torch.rand(HALF, 6, generator=generator) - 1.0
        env.step(torch.cat((one, adapter.mirror.actions(one))))
        observed = adapter.get_observations()
        image = adapter.mirror.observations(observed[:HALF])["critic"]
        if step:  # After one step, histories still contain frames of the reset.
            torch.testing.assert_close(image, observed["critic"][HALF:], atol=2e-3, rtol=2e-3)
        touched += float(env.scene["contact_forces"].data.net_forces_w.abs().sum())
    assert touched > 1.0
    parts = env.observation_manager.split("critic", observed["critic"][:HALF])
    mirrored = env.observation_manager.split("critic", image)
    assert {name for name in parts if torch.allclose(parts[name], mirrored[name], atol=1e-3)} == set()
    assert len(parts) == len(SEEN) + 2
    twice = adapter.mirror.observations(adapter.mirror.observations(observed))
    assert torch.equal(twice["critic"], observed["critic"])


@pytest.mark.usefixtures("allow_test_terms")
@pytest.mark.parametrize("alignment", ["yaw", "world"])
def test_a_scan_from_the_mirrored_place_of_a_mirrored_ground_is_the_image(make_trainer, alignment):
    scanner = "env.scene.sensors.height_scanner"
    words = ["env.scene.terrain._target_=sim.sensors.grounds.Roof", f"{scanner}.ray_alignment={alignment}"]
    adapter = make_trainer(*WORDS, *words, seen("sensors/height_scan"), f"{CRITIC}.terms.height_scan.clip=[-9,9]").env
    env, generator = adapter.env, torch.Generator().manual_seed(2)
    env.reset()
    place = torch.rand(HALF, 3, generator=generator) + torch.tensor([0.0, 0.2, 0.5])
    place[:4, 1] = 0.05  # above the ridge
    turn = torch.nn.functional.normalize(torch.randn(HALF, 4, generator=generator), dim=1)
    pose = both(torch.cat((place, turn), dim=1), 1, -1, 1, 1, -1, 1, -1)
    env.scene.robot.write_root_pose_to_sim(pose)
    env.scene.refresh()
    observed = env.observation_manager.peek()["critic"][:, -54:]
    mirror = adapter.mirror._groups["critic"]
    image = observed[:HALF, mirror[0][-54:] - 54] * mirror[1][-54:]
    torch.testing.assert_close(image, observed[HALF:], atol=1e-4, rtol=1e-4)
    assert (image - observed[:HALF]).abs().max() > 0.1


def rule(trainer, group, width):
    """Return the source index and the sign of each number in the first frame of a mirrored group."""
    sources, signs = trainer.env.mirror._groups[group]
    return sources[:width].tolist(), signs[:width].tolist()


def test_the_rays_of_a_grid_and_of_a_lidar_change_sides(make_trainer):
    pattern = "{_target_: wheelleg_exp.sim.sensors.GridPattern, resolution: 0.1, size: [0.2, 0.1]}"
    word = f"env.scene.sensors.height_scanner.pattern={pattern}"
    sources, signs = rule(make_trainer(*WORDS, word, seen("sensors/height_scan")), "critic", 6)
    assert (sources, signs) == ([3, 4, 5, 0, 1, 2], [1.0] * 6)
    lidar, name = "env.scene.sensors.lidar.pattern", f"{CRITIC}.terms.height_scan.sensor_cfg.name=lidar"
    words = [f"{lidar}.channels=1", f"{lidar}.vertical_fov_range=[0.0,0.0]", f"{lidar}.horizontal_res={math.pi / 2}"]
    every = [word.replace("[height_scanner,imu]", "[height_scanner,imu,lidar]") for word in WORDS]
    sources, signs = rule(make_trainer(*every, *words, seen("sensors/height_scan"), name), "critic", 4)
    assert (sources, signs) == ([0, 3, 2, 1], [1.0] * 4)


def test_the_clocks_of_both_legs_change_sides(make_trainer):
    trainer = make_trainer(*WORDS, seen("gait_phase"))
    t = torch.arange(5) / 7
    left, right = 2 * math.pi * t, 2 * math.pi * (t + 0.5)
    clocks = torch.stack((left.sin(), right.sin(), left.cos(), right.cos()), dim=1)
    swapped = clocks[:, [1, 0, 3, 2]]
    sources, signs = rule(trainer, "critic", 4)
    torch.testing.assert_close(clocks[:, sources] * torch.tensor(signs), swapped)


def test_an_imu_that_is_turned_along_its_body_has_signs_of_its_own(make_trainer):
    turned = f"{IMU}.offset={{rot: [{math.sqrt(0.5)}, {math.sqrt(0.5)}, 0.0, 0.0]}}"
    trainer = make_trainer(*WORDS, turned, seen("sensors/imu_lin_acc", "sensors/imu_ang_vel"))
    assert rule(trainer, "critic", 3) == ([0, 1, 2], [1.0, 1.0, -1.0])
    slices = trainer.env.env.observation_manager.term_slices("critic")
    start = slices["imu_ang_vel"].start
    assert trainer.env.mirror._groups["critic"][1][start : start + 3].tolist() == [-1.0, -1.0, 1.0]


SCAN, TERMS = "env.scene.sensors.height_scanner", f"{CRITIC}.terms"
ASIDE = f"{IMU}.offset={{rot: [0.7071, 0.7071, 0.0, 0.0]}}"
ONE_WHEEL = f"{TERMS}.wheel_contacts.sensor_cfg="
ONE_WHEEL += "{_target_: wheelleg_exp.managers.SceneEntityCfg, name: contact_forces, body_names: [l_wheel_link]}"


@pytest.mark.parametrize(
    ("words", "key", "said"),
    [
        ([seen("sensors/height_scan"), f"{SCAN}.offset={{pos: [0.0, 0.01, 0.5]}}"], SCAN, "left-right symmetric"),
        ([seen("sensors/height_scan"), f"{SCAN}.body_name=l_wheel_link"], f"{SCAN}.body_name", "r_wheel_link"),
        ([seen("sensors/imu_ang_vel"), f"{IMU}.offset={{pos: [0.0, 0.01, 0.0]}}"], f"{IMU}.offset.pos", "y = 0"),
        ([seen("sensors/imu_ang_vel"), f"{IMU}.offset={{rot: [0.96, 0.28, 0.0, 0.0]}}"], f"{IMU}.offset.rot", "axes"),
        ([seen("sensors/imu_orientation"), f"{IMU}.offset={{rot: [0.0, 0.0, 0.0, 1.0]}}"], None, ""),
        ([seen("sensors/imu_orientation"), ASIDE], "offset.rot", "about y"),
        ([seen("sensors/wheel_contacts"), ONE_WHEEL], f"{TERMS}.wheel_contacts", "'r_wheel_link' is not"),
        ([seen("gait_phase"), f"{TERMS}.gait_phase.offsets=[0.0]"], f"{TERMS}.gait_phase.offsets", "invariant"),
        (["command@env.commands=[base_velocity,body_pose]", shown("body_pose")], "body_pose.body_name", "r_wheel_link"),
    ],
)
def test_a_config_without_a_mirror_image_is_rejected_with_its_key(make_trainer, words, key, said):
    check_mirror(make_trainer, [*WORDS, *words], key, said)


def test_a_clock_of_legs_that_move_together_can_be_set_to_stay(make_trainer):
    words = [seen("gait_phase"), f"{TERMS}.gait_phase.offsets=[0.0]", "+agent.symmetry.terms={gait_phase: invariant}"]
    assert rule(make_trainer(*WORDS, *words), "critic", 2) == ([0, 1], [1.0, 1.0])
