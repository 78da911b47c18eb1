import mujoco
import numpy as np
import pytest
import torch
from recording.conftest import STEPS, Account, record, roll_out

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.rerun_program import optimize_recording
from wheelleg_exp.recording.writing.recorder import Recorder

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording(recorded) -> Recording:
    return Recording(recorded[0])


def column(recording: Recording, *entities: str) -> np.ndarray:
    return np.hstack([recording.values(entity) for entity in entities])


def listed(recording: Recording, entity: str, name: str) -> list:
    return recording.table(entity).column(name).to_pylist()


def test_the_trajectory_is_the_same_to_the_bit_with_and_without_a_recorder(make_env, recorded):
    alone = roll_out(make_env(), Account(1))
    assert len(alone.returned) == len(recorded[1].returned)
    for without, with_recorder in zip(alone.returned, recorded[1].returned, strict=True):
        torch.testing.assert_close(without, with_recorder, rtol=0, atol=0)


def test_every_control_step_is_there_once_on_every_timeline(recording, recorded):
    table = recording.table("base/height")
    assert table.column("step").to_pylist() == list(range(1, STEPS + 1))
    seconds = np.asarray(table.column("sim_time").cast("int64")) * 1e-9
    np.testing.assert_allclose(seconds, np.arange(1, STEPS + 1) * recorded[2].step_dt, atol=1e-6)
    assert recording.timelines() == ["step", "sim_time"]


@pytest.mark.parametrize(
    ("entities", "name"),
    [
        (["base/height"], "height"),
        (["base/gravity"], "gravity"),
        (["base/v_x", "base/v_y", "base/v_z"], "lin_vel"),
        ([f"commands/base_velocity/{part}" for part in ("v_x", "v_y", "w_z")], "command"),
        (["observations/policy"], "policy"),
        (["observations/critic"], "critic"),
        (["actions/raw"], "action"),
        (["state/qpos"], "qpos"),
        (["joints/{}/position"], "joint_pos"),
        (["joints/{}/velocity_target"], "joint_vel_target"),
        (["joints/{}/effort"], "effort"),
    ],
)
def test_numbers_are_the_environments_own_and_joints_are_found_by_name(recording, recorded, entities, name):
    joints = recorded[2].scene.robot.joint_names
    found = [entity.format(joint) for entity in entities for joint in (joints if "{}" in entity else joints[:1])]
    np.testing.assert_array_equal(column(recording, *found), recorded[1][name])


def test_roll_and_pitch_agree_with_the_direction_of_gravity(recording, recorded):
    roll, pitch = (recording.values(f"base/{name}")[:, 0] for name in ("roll", "pitch"))
    gravity = np.stack((np.sin(pitch), -np.cos(pitch) * np.sin(roll), -np.cos(pitch) * np.cos(roll)), axis=1)
    np.testing.assert_allclose(gravity, recorded[1]["gravity"], atol=1e-6)


def test_body_poses_are_those_of_mujoco_relative_to_the_environments_origin(recording, recorded):
    _, account, env = recorded
    data, model = mujoco.MjData(env.scene.model), env.scene.model
    origin = env.scene.env_origins[1].numpy()
    assert np.abs(origin).max() > 1, "the case is worth something only away from the centre"
    for body in env.scene.robot.body_names:
        translation, quaternion = (listed(recording, f"world/{body}", name) for name in ("translation", "quaternion"))
        for step in (0, 40, STEPS - 1):
            data.qpos[:] = account["qpos"][step]
            mujoco.mj_forward(model, data)
            w, x, y, z = data.body(body).xquat
            np.testing.assert_allclose(translation[step][0], data.body(body).xpos - origin, atol=1e-6)
            np.testing.assert_allclose(quaternion[step][0], [x, y, z, w], atol=1e-6)


def test_contact_arrows_stand_at_the_bodies_that_are_touched(recording, recorded):
    _, account, env = recorded
    bodies, forces = env.scene["contact_forces"].body_names, account["forces"].astype(float)
    norms = recording.values("contacts/contact_forces")
    assert recording.names("contacts/contact_forces") == bodies
    np.testing.assert_allclose(norms, np.linalg.norm(forces, axis=2), rtol=1e-12)
    vectors = listed(recording, "overlay/contacts/contact_forces", "vectors")
    origins = listed(recording, "overlay/contacts/contact_forces", "origins")
    scales = set()
    for step in range(STEPS):
        touched = np.flatnonzero(norms[step] > 0)
        assert len(vectors[step]) == len(touched) == len(origins[step])
        for arrow, origin, body in zip(vectors[step], origins[step], touched, strict=True):
            place = listed(recording, f"world/{bodies[body]}", "translation")[step][0] if step == 50 else None
            assert place is None or place == origin
            scales.add(round(np.linalg.norm(arrow) / norms[step, body], 5))
    assert len(scales) == 1, "one scale for all"


def test_velocity_arrows_are_turned_by_the_yaw_of_the_base(recording, recorded):
    yaw = recording.values("base/yaw")[:, 0]
    scale = None
    for name, key in (("command", "command"), ("actual", "lin_vel")):
        arrows = np.array(listed(recording, f"overlay/velocity/{name}", "vectors"))[:, 0]
        velocity = recorded[1][key].astype(float)
        world = (np.cos(yaw) + 1j * np.sin(yaw)) * (velocity[:, 0] + 1j * velocity[:, 1])
        ratio = (arrows[:, 0] + 1j * arrows[:, 1]) / world
        scale = scale or ratio[0].real
        np.testing.assert_allclose(ratio, scale, rtol=1e-4)
        assert (arrows[:, 2] == 0).all()


def test_the_log_names_ends_of_episodes_and_interval_events_at_their_steps(recording, recorded):
    ended = recorded[1].ended
    assert ended, "the rollout must hold an end"
    steps, texts = (listed(recording, "log/episodes", name) for name in ("step", "text"))
    assert steps == [step for step, _, _ in ended]
    expected = [f"env 1: ended by {' and '.join(names)} after {seconds:.2f} s" for _, names, seconds in ended]
    assert [text[0] for text in texts] == expected
    pushed = recorded[1].pushed
    assert pushed
    assert listed(recording, "log/events", "step") == pushed
    assert listed(recording, "log/events", "text") == [["env 1: push_robot"]] * len(pushed)
    assert listed(recording, "events/push_robot", "step") == pushed
    assert recording.values("events/push_robot").tolist() == [[1.0]] * len(pushed)
    assert recording.static("events")["terms"] == ["push_robot"]


def test_a_push_shows_in_the_row_after_it(make_env, tmp_path):
    sideways = "env.events.push_robot.velocity_range.y=[1.0,1.0]"
    env = make_env(sideways, "env.events.push_robot.interval_range_s=[0.1,0.15]", num_envs=2)
    record(tmp_path / "r.rrd", env, env_ids=(0,), steps=25)
    recording = Recording(tmp_path / "r.rrd")
    pushed = listed(recording, "events/push_robot", "step")
    change = np.diff(recording.values("state/qvel")[:, 1])
    assert len(pushed) >= 2
    assert [step for step, jump in enumerate(change, start=1) if jump > 0.5] == [step for step in pushed if step < 25]


def test_the_robot_is_drawn_once_and_statically(recording, recorded):
    model = recorded[2].scene.model
    for geom in range(model.ngeom):
        name, body = model.geom(geom).name, model.body(model.geom_bodyid[geom]).name
        if body == "world":
            continue
        visual = model.geom_group[geom] == 2
        place = f"world/{body}/{name}" if visual else f"overlay/colliders/{body}/{name}"
        assert recording.static(place), place
        assert not recording.has_rows(place)


def test_several_environments_have_a_branch_each(make_env, tmp_path):
    account = record(tmp_path / "r.rrd", make_env(), env_ids=(2, 0), steps=10)
    recording = Recording(tmp_path / "r.rrd")
    np.testing.assert_array_equal(recording.values("env_2/base/height"), account["height"])
    assert "env_0/rewards/total" in recording.entities()
    root = next(e for e in recording.entities() if e.startswith("world/env_0/"))
    assert recording.static("world/env_0")["translation"] != [[0, 0, 0]], root


@pytest.mark.parametrize("env_ids", [[], [4], [-1], [0, 0]])
def test_environments_that_do_not_exist_are_refused_before_a_file_is_made(recorded, tmp_path, env_ids):
    with pytest.raises(ConfigError, match=r"recording\.env_ids"):
        Recorder(tmp_path / "r.rrd", recorded[2], recording_id="r", name="n", env_ids=env_ids, purpose="play")
    assert not (tmp_path / "r.rrd").exists()


def test_a_term_that_would_share_a_place_is_refused(make_env, tmp_path):
    term = "{_target_: wheelleg_exp.mdp.rewards.is_alive, weight: 1.0}"
    env = make_env(f"+env.rewards.total={term}")
    with pytest.raises(ConfigError, match=r"env\.rewards\.total"):
        Recorder(tmp_path / "r.rrd", env, recording_id="r", name="n", env_ids=[0], purpose="play")
    assert list(tmp_path.iterdir()) == []


def test_a_finished_recording_is_put_together_and_has_an_index(make_env, tmp_path, monkeypatch):
    path, env = tmp_path / "r.rrd", make_env(num_envs=2)
    monkeypatch.setattr("wheelleg_exp.recording.writing.recording_file.optimize_recording", lambda path: False)
    record(path, env, env_ids=(0,), steps=40, flush_every=4)
    before, pieces = entity_digests(path), Recording(path).health
    assert optimize_recording(path) is None
    after = Recording(path).health
    assert entity_digests(path) == before
    assert (after.is_whole, pieces.is_closed) == (True, False)
    assert (after.messages < pieces.messages / 3, after.size < pieces.size) == (True, True)
    assert [p.name for p in tmp_path.iterdir()] == ["r.rrd"]
