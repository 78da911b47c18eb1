"""Driving a run by a script: what is simulated, what is kept, and that the same is driven again."""

import json
import shlex
import socket
import sys
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import yaml
from patience import wait_until

from jobs.small import refused, succeed, wheelleg
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.drive.drive_page import require_free
from wheelleg_exp.jobs.drive.drive_script import Choose, Finish, Push
from wheelleg_exp.jobs.drive.run_drive import DriveRequest, RealTimePacer, drivable, drive, policies
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.run.run_config import load_params
from wheelleg_exp.run.run_directory import RunDirectory

RANGES = [f"env.commands.base_velocity.ranges.{axis}=[-0.3,0.3]" for axis in ("lin_vel_x", "ang_vel_z")]
SCRIPT = """\
- {for: 0.1, lin_vel_x: 0.2}
- {for: 0.1, ang_vel_z: -0.1, push: [0.05, 0.0]}
- {for: 0.1, stop: true, reset: true}
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "script.yaml"
    path.write_text(SCRIPT)
    return path


def driven(*words):
    (made,) = json.loads(succeed("play", "latest", *words, *RANGES, "--json").out)["drives"]
    return made


@pytest.mark.train
def test_a_script_is_driven_recorded_saved_and_drives_the_same_again(run, script):
    made = driven("--script", script)
    folder, figures = run.play / made["folder"].rsplit("/", 1)[1], made["figures"]
    assert json.loads((folder / "figures.json").read_text()) == figures
    assert (figures["duration_s"], figures["steps"]) == (pytest.approx(0.3), 18)
    assert (figures["resets"], figures["pushes"], figures["scene"]) == (1, 1, "own")
    (entry,) = run.manifest().data["additions"]
    assert entry["kind"] == "drive"
    assert {name.rsplit("/", 1)[1] for name in entry["files"]} == {"driven.yaml", "figures.json", "recording.rrd"}
    assert wheelleg("verify", run.path).status == 0

    commands = np.stack([_command(folder, name) for name in ("v_x", "w_z")], axis=1)
    assert len(commands) == 18
    # A recorded frame shows the command at the start of its control step.
    expected = [(0.0, 0.0)] + [(0.2, 0.0)] * 6 + [(0.2, -0.1)] * 5 + [(0.0, 0.0)] * 6
    np.testing.assert_allclose(commands, expected, atol=1e-6)

    assert {**driven("--script", folder / "driven.yaml")["figures"]} == figures


@pytest.mark.train
def test_a_repeated_drive_is_equal(run, script):
    said = wheelleg("play", "latest", "--script", script, "--scene", "rough", "--checkpoint", "1", *RANGES)
    (line,) = [line for line in said.out.splitlines() if line.startswith("repeat: ")]
    succeed(*shlex.split(line)[2:], "--json")
    first, second = (json.loads(path.read_text()) for path in sorted(run.play.glob("*/figures.json")))
    assert (first, first["scene"], first["overrides"]) == (second, "rough", RANGES)


def _command(folder, name):
    return Recording(folder / "recording.rrd").values(f"commands/base_velocity/{name}").ravel()


@pytest.mark.train
def test_undrivable_runs_are_rejected(run, script):
    said = refused("play", "latest", "--script", script)
    assert [word for word in ("lin_vel_x: unknown key in a script", f"{script}:1") if word not in said] == []
    said = refused("play", "latest", "--script", script, "--scene", "stars")
    assert [word for word in ("did you mean 'stairs'?", "--scene") if word not in said] == []
    for words in (["--scene", "flat"], ["--port", "8080"]):
        said = refused("play", "latest", *words)
        assert "--drive or --script FILE" in said
    assert not run.play.exists() or not list(run.play.iterdir())


@pytest.mark.train
@pytest.mark.parametrize("absent", ["viser", "mjviser"])
def test_a_page_without_its_extra_names_the_package(run, monkeypatch, absent):
    monkeypatch.setitem(sys.modules, absent, None)
    said = refused("play", "latest", "--drive", "--port", "0", *RANGES)
    assert [word for word in (absent, 'pip install "wheelleg_exp[drive]"') if word not in said] == []
    assert not run.play.exists()


@pytest.mark.train
def test_the_address_and_the_ports_are_printed_before_the_drive(run, monkeypatch):
    pytest.importorskip("mjviser", reason="the extra 'drive' is not installed")
    from websockets.sync.client import connect

    found = []

    def paused(request, display, page, others):
        (line,) = [line for line in sys.stderr.getvalue().splitlines() if line.startswith("{")]
        start = json.loads(line)
        assert (start["port"], start["keys_port"]) == page.ports  # With a wrong port, the test would wait for minutes.
        with urlopen(start["url"]) as answer:
            found.append(answer.status)
        with connect(f"ws://127.0.0.1:{start['keys_port']}", origin=f"http://localhost:{start['port']}") as keys:
            keys.send('{"press": "pause"}')
            found.append(wait_until(lambda: page._hands.controls.paused))
        found.append(start["run"])
        return []

    monkeypatch.setattr("wheelleg_exp.jobs.drive.run_drive.drive", paused)
    said = succeed("play", "latest", "--drive", "--port", "0", "--json")
    assert found == [200, True, str(run.path)]
    assert json.loads(said.out) == {"run": str(run.path), "drives": []}


@pytest.mark.train
def test_whoever_drives_is_not_disturbed(run):
    env, _ = load_params(run)
    env["commands"]["base_velocity"]["rel_standing_envs"] = 0.4
    tree = {"env": env, "drive": yaml.safe_load("episode_length_s: 3600.0")}
    assert {node["mode"] for node in env["events"].values()} == {"startup", "reset", "interval"}
    changed = drivable(tree)["env"]
    assert {node["mode"] for node in changed["events"].values()} == {"startup", "reset"}
    assert (changed["num_envs"], changed["episode_length_s"], changed["curriculum"]) == (1, 3600.0, {})
    assert (changed["commands"]["base_velocity"]["rel_standing_envs"], changed["scene"]) == (0.0, env["scene"])
    rough = drivable(tree, "rough")["env"]["scene"]
    assert rough["terrain"]["_target_"].endswith("TerrainGenerator")
    assert rough["sensors"]["contact_forces"]["max_contacts"] == 8
    assert env["num_envs"] != 1


class Hands:
    """A user who pushes the robot over, has it get up, and drives on."""

    def __init__(self):
        self.opened, self.heights, self.asked = [], [], True

    def open(self, session, choice, options, checkpoints):
        self.session, self.asked = session, False
        self.opened.append((choice.policy, checkpoints[-1].parent.name.split("_")[0]))
        self.heights.append(float(session.env.scene.robot.data.root_pos_w[0, 2]))
        session.controls.speed = 50.0
        session.controls.set("lin_vel_x", 0.2)
        return "nowhere"

    def show(self, status):
        policy = self.opened[-1][0]
        if policy is None and status.fallen is None and status.time_s > 0.5:
            self.session.controls.request(Push(2.5))
        wanted = None
        if policy is None and status.fallen is not None:
            wanted = Choose(policy="stock:get_up")
        elif policy == "stock:get_up" and status.time_s > 2.0:
            wanted = Choose(policy="stock:walk")
        elif policy == "stock:walk" and status.time_s > 4.0:
            wanted = Finish()
        if wanted is not None and not self.asked:
            self.asked = True
            self.session.controls.request(wanted)


@pytest.mark.train
def test_a_fallen_robot_gets_up_with_another_policy_and_drives_on():
    run, hands = RunDirectory.open("stock:walk", "runs"), Hands()
    request = DriveRequest(run, overrides=["recording.enabled=false"])
    drives = drive(request, Display(), hands, policies(run, Path("runs")))
    assert hands.opened == [(None, "walk"), ("stock:get_up", "get"), ("stock:walk", "walk")]
    start, lying, standing = hands.heights
    assert lying < 0.05 < 0.065 < standing < start
    assert [made.figures["handed_over"] for made in drives] == [False, True, True]
    assert [sum(made.figures["falls"].values()) for made in drives] == [1, 0, 0]
    assert drives[2].figures["distance_m"] > 0.5  # m; the command asks for 0.8 m.


@pytest.mark.train
def test_a_policy_takes_over_on_the_ground_where_the_robot_is():
    tree, _ = load_params(RunDirectory.open("stock:get_up", "runs"))
    options = {"env": tree, "drive": {"episode_length_s": 10.0}}
    rough = drivable(options, "rough")["env"]["scene"]
    taken = drivable(options, handed_over=rough)["env"]
    assert taken["scene"]["terrain"] == rough["terrain"] != tree["scene"]["terrain"]
    assert "reset_lying" in tree["events"]
    assert "reset_lying" not in taken["events"]  # The resting poses fit only level ground.


def test_steps_are_as_far_apart_as_they_last_and_a_slow_machine_is_not_chased():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    pace = RealTimePacer(0.02, 25.0, clock=lambda: now[0], sleep=sleep)
    pace.wait(1.0)
    pace.wait(0.5)
    assert slept == pytest.approx([0.02, 0.04])
    now[0] += 5.0  # something took five seconds
    for _ in range(10):
        pace.wait(1.0)
    assert (sum(slept[2:]), [pace.is_frame_due(), pace.is_frame_due()]) == (pytest.approx(0.1, abs=0.03), [True, False])
    now[0] += 0.05
    assert pace.is_frame_due()


@pytest.fixture
def busy():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


def test_a_port_in_use_is_reported_with_other_ports(busy):
    with pytest.raises(WheellegError, match=rf"^--port: port {busy}, for the page, is in use; .* or --port 0"):
        require_free(busy, "the page")


@pytest.mark.parametrize("port", [-1, 65536])
def test_an_invalid_port_is_rejected(port):
    with pytest.raises(WheellegError, match=f"the port {port} for the page is not a valid TCP port"):
        require_free(port, "the page")


@pytest.mark.train
def test_the_port_of_the_keys_is_the_one_after_the_pages(run, busy):
    said = refused("play", "latest", "--drive", "--port", str(busy - 1), "env.commands.base_velocity.ranges={}")
    assert f"port {busy}, for the page's keys and gamepads, is in use" in said
