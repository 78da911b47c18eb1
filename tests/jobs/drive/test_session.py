"""One robot that is driven: commands reach it, requests are obeyed, and nothing happens unasked."""

import math
import socket
import threading
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
import yaml
from patience import PATIENCE_S

from jobs.drive.cart import RADIUS, VELOCITY, cart, cart_env, driver
from wheelleg_exp.config.schema import Drive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.drive.drive_page import DrivePage, InputServer
from wheelleg_exp.jobs.drive.drive_script import Axis, Choose, Controls, Jump, Push, Reset, ScriptPlayer, read_script
from wheelleg_exp.jobs.drive.drive_session import DriveSession
from wheelleg_exp.rl.vec_env import RslRlVecEnv

OPTIONS = Drive(episode_length_s=3600.0, push=0.1, fall_shown_s=1.0, get_up=None, frames_per_s=60.0)
LOW = {"low": {"_target_": "wheelleg_exp.mdp.terminations.root_height_below_minimum", "minimum_height": 1.0}}


def drive(session, seconds):
    for _ in range(round(seconds / session.env.step_dt)):
        session.step()


def test_only_axes_with_a_range_can_be_driven_and_the_first_observation_shows_rest(tmp_path):
    session, term = cart(tmp_path), "base_velocity"
    axes = [Axis("lin_vel_x", term, "lin_vel_x", -0.4, 0.4), Axis("ang_vel_z", term, "ang_vel_z", -0.5, 1.0)]
    assert session.axes == axes
    assert session.env.observation_manager.obs_buf["policy"].tolist() == [[0.0, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("low", "high", "shares"),
    [
        (-0.4, 0.4, {-1.0: -0.4, 0.0: 0.0, 0.5: 0.2, 1.0: 0.4, 7.0: 0.4}),
        (-0.5, 1.0, {-1.0: -0.5, -0.5: -0.25, 0.5: 0.5}),
        (0.06, 0.08, {-1.0: 0.06, 0.0: 0.07, 1.0: 0.08}),  # The height range does not contain 0.
    ],
)
def test_a_stick_takes_an_axis_from_rest_to_its_ends(low, high, shares):
    axis = Axis("a", "t", "a", low, high)
    assert [axis.at(share) for share in shares] == pytest.approx(list(shares.values()))


def test_the_cart_drives_straight_and_turns_as_commanded(tmp_path):
    session = cart(tmp_path)
    session.controls.set("lin_vel_x", 0.3)
    drive(session, 2.0)
    x, y = session.env.scene.robot.data.root_pos_w[0, :2].tolist()
    assert x == pytest.approx(0.6, rel=0.05)
    assert abs(y) < 0.01
    assert session.status().measured["lin_vel_x"] == pytest.approx(0.3, rel=0.03)
    figures = session.meter.figures()
    assert (figures["distance_m"], figures["duration_s"]) == (pytest.approx(x, rel=0.05), pytest.approx(2.0))
    assert figures["tracking_rmse"]["lin_vel_x"] < 0.1
    session.controls.set("lin_vel_x", 0.0)
    session.controls.steer("ang_vel_z", 1.0)
    drive(session, 1.0)
    assert session.status().commands["ang_vel_z"] == 1.0
    assert session.status().measured["ang_vel_z"] > 0.3  # Wheels that do not steer slide in a turn.


def test_a_command_stands_through_redraws_and_resets_and_beyond_its_range_it_is_its_end(tmp_path):
    session = cart(tmp_path)
    session.controls.set("lin_vel_x", 7.0)
    session.controls.set("nothing", 1.0)
    session.controls.set("ang_vel_z", math.nan)
    term = session.env.command_manager.get_term("base_velocity")
    for _ in range(40):  # Commands are redrawn every 0.1 s.
        session.step()
        assert term.command[0].tolist() == pytest.approx([0.4, 0.0, 0.0])
    session.obey(Reset())
    assert term.command[0].tolist() == pytest.approx([0.4, 0.0, 0.0])


def test_a_push_adds_velocity_in_the_yaw_axes(tmp_path):
    session = cart(tmp_path)
    data, ids = session.env.scene.robot.data, torch.zeros(1, dtype=torch.long)
    quarter = torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]])  # The robot faces the y axis of the world.
    session.env.scene.robot.write_root_pose_to_sim(torch.cat((data.root_pos_w, quarter), dim=1), ids)
    session.env.scene.refresh()
    session.obey(Push(0.2, 0.1))
    assert data.root_lin_vel_w[0].tolist() == pytest.approx([-0.1, 0.2, 0.0], abs=1e-6)
    assert session.meter.figures()["pushes"] == 1


def test_a_fall_waits_until_somebody_resets(tmp_path):
    session = cart(tmp_path, terminations=LOW)
    session.step()
    assert session.fallen == "low"
    assert int(session.env.episode_length_buf[0]) == 1  # not reset by itself
    session.obey(Push(0.3))  # A fallen robot is not pushed.
    assert session.meter.figures()["pushes"] == 0
    session.reset()
    assert session.fallen is None
    assert (int(session.env.episode_length_buf[0]), session.meter.figures()["falls"]) == (0, {"low": 1})


def test_several_robots_cannot_be_driven(tmp_path):
    env = cart_env(tmp_path, num_envs=2)
    with pytest.raises(ConfigError, match=r"env\.num_envs"):
        DriveSession(RslRlVecEnv(env), driver(env))


def test_what_was_driven_is_a_script_of_it(tmp_path):
    session = cart(tmp_path)
    drive(session, 0.1)
    session.controls.set("lin_vel_x", 0.2)
    drive(session, 0.2)
    session.obey(Push(0.1))
    session.obey(Reset())
    drive(session, 0.1)
    assert session.driven.script(session.steps) == [
        {"at": 0.0, "lin_vel_x": 0.0, "ang_vel_z": 0.0},
        {"at": 0.1, "lin_vel_x": 0.2},
        {"at": 0.3, "push": [0.1, 0.0]},
        {"at": 0.3, "reset": True, "for": 0.1},
    ]


def test_a_jump_is_commanded_once_on_request_and_repeats_from_the_script(tmp_path):
    fields = {"resampling_time_range": [0.4, 0.4], "window_s": 0.2}
    jump = {"_target_": "wheelleg_exp.mdp.commands.JumpCommand", **fields}
    session = cart(tmp_path, commands={"base_velocity": VELOCITY, "jump": jump})
    command = session.env.command_manager.get_term("jump").command
    for _ in range(50):
        session.step()
        assert float(command) == 0.0  # No jump without a request.
    session.obey(Jump())
    seen = []
    for _ in range(50):
        session.step()
        seen.append(float(command))
    assert sum(value > 0.0 for value in seen) == 10
    assert session.meter.figures()["jumps"] == 1
    assert {"at": 1.0, "jump": True, "for": 1.0} in session.driven.script(session.steps)


def _stopped_cart(folder):
    """A cart that jumps; a step at 0.2 m stops its wheels unless it jumps."""
    wheels = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", "joint_names": [".*_axle"]}
    travel = {"_target_": "wheelleg_exp.mdp.commands.UniformVelocityTravelCommand", "wheel_cfg": wheels}
    travel |= {"wheel_radius": RADIUS, "max_travel_error": 1.0, "max_heading_error": 1.0, "max_lin_acceleration": 2.0}
    jump = {"_target_": "wheelleg_exp.mdp.commands.JumpCommand", "velocity_command": "base_velocity", "window_s": 0.4}
    jump |= {"resampling_time_range": [9.0, 9.0], "bump": {"wait_s": 0.3, "back": 0.1, "run_up": 0.25}}
    hop = {name: jump[name] for name in ("_target_", "resampling_time_range", "window_s")}  # It cannot wait for bumps.
    env = cart_env(folder, commands={"base_velocity": VELOCITY | travel, "hop": hop, "jump": jump})

    def policy(observations):
        x, jumps = float(env.scene.robot.data.root_pos_w[0, 0]), float(env.command_manager.get_command("jump")) > 0.0
        is_stopped = 0.2 < x < 0.22 and float(observations["policy"][0, 0]) > 0.0 and not jumps
        return driver(env)(observations) * (not is_stopped)

    return DriveSession(RslRlVecEnv(env), policy)


def test_the_key_for_bumps_makes_a_stopped_robot_back_up_and_jump_and_a_script_repeats_it(tmp_path):
    pytest.importorskip("mjviser", reason="the extra 'drive' is not installed")
    session, way = _stopped_cart(tmp_path), []
    commands = session.env.command_manager

    def drive_on(seconds):
        for _ in range(round(seconds / session.env.step_dt)):
            session.step()
            speed, jump = commands.get_command("base_velocity")[0, 0], commands.get_command("jump")
            way.append((float(session.env.scene.robot.data.root_pos_w[0, 0]), float(speed), float(jump)))

    with DrivePage(0, ["own"], []) as page:
        page.open(session, Choose(), OPTIONS, [tmp_path / "model_1.pt"])
        session.controls.set("lin_vel_x", 0.3)
        drive_on(2.0)
        place, speed, jump = way[-1]
        assert (place, speed, jump) == (pytest.approx(0.2, abs=0.02), pytest.approx(0.3), 0.0)  # The user sees no jump.
        page._hands.press("trigger")
        page.show(session.status())
        assert page._bumps.label == "Jump at bumps: on"
        drive_on(3.0)
        start = next(x for x, _, jump in way if jump > 0.0)
        assert min(way[100:])[0] < place - 0.1  # m, ``back``
        assert start == pytest.approx(place - 0.11 * 0.25, abs=0.01)  # m, ``before_s * run_up``
        assert (way[-1][0] > 0.3, way[-1][1]) == (True, pytest.approx(0.3))  # beyond the step, as the user wants
        page._hands.press("trigger")
        drive_on(0.1)
    changes = [abs(now - before) for (_, before, _), (_, now, _) in pairwise(way)]
    assert max(changes) == pytest.approx(2.0 * 0.02, rel=1e-3)  # m/s; ``max_lin_acceleration`` in a step of 20 ms
    entries = session.driven.script(session.steps)
    assert [(entry["at"], entry["trigger"]) for entry in entries if "trigger" in entry] == [
        (0.0, "step"),
        (2.0, "bump"),
        (5.0, "step"),
    ]
    (path := tmp_path / "driven.yaml").write_text(yaml.safe_dump(entries))
    again = _stopped_cart(tmp_path)
    hand = ScriptPlayer(read_script(path, again.axes), again.controls, again.env.step_dt)
    for step in range(hand.last_step):
        hand.before(step)
        again.step()
    assert again.env.scene.robot.data.root_pos_w.tolist() == session.env.scene.robot.data.root_pos_w.tolist()


def test_the_key_for_getting_up_hands_over_and_back(tmp_path):
    pytest.importorskip("mjviser", reason="the extra 'drive' is not installed")
    session, options, asked = cart(tmp_path), replace(OPTIONS, get_up="stock:get_up"), []
    with DrivePage(0, ["own"], ["mine", "stock:get_up"]) as page:
        for now in (None, "stock:get_up", "mine"):
            page.open(session, Choose(policy=now), options, [tmp_path / "model_1.pt"])
            page._hands.press("get_up")
            asked += session.controls.take()
        with pytest.raises(ConfigError, match=r"drive\.get_up: there is no policy 'stock:got_up'.*did you mean"):
            page.open(session, Choose(), replace(options, get_up="stock:got_up"), [])
    assert asked == [Choose(policy=name) for name in ("stock:get_up", "mine", "stock:get_up")]
    with DrivePage(0, ["own"], ["stock:get_up"]) as page:  # There is no policy to hand the robot back to.
        page.open(session, Choose(), options, [tmp_path / "model_1.pt"])
        page._hands.press("get_up")
    assert session.controls.take() == []


def test_requests_of_many_threads_are_all_taken_once(tmp_path):
    controls = Controls([Axis("a", "t", "a", -1.0, 1.0)])
    threads = [threading.Thread(target=lambda: [controls.request(Reset()) for _ in range(100)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    taken = []
    while any(thread.is_alive() for thread in threads):
        taken += controls.take()
    taken += controls.take()
    assert (len(taken), controls.take()) == (400, [])


def test_a_wrong_message_prints_no_traceback(capfd):
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    controls = Controls([])
    with InputServer(controls, ["http://here"]) as server:
        port = server._server.socket.getsockname()[1]
        with connect(f"ws://127.0.0.1:{port}", origin="http://here") as page:
            page.send("x" * 1025)
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=PATIENCE_S)
        with socket.create_connection(("127.0.0.1", port)) as stranger:
            stranger.sendall(b"nonsense\r\n\r\n")
            stranger.recv(100)
    assert "Traceback" not in "".join(capfd.readouterr())
