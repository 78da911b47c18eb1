"""The supervised step of a bundle: injected faults, falls, start-up, and the C header on the same readings.

A linear balancer replaces the network of a small training, so that the robot of the bundle stands in MuJoCo.
"""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE_S, thinned
from robot_logs.made import programs

from jobs.small import succeed
from wheelleg_exp.jobs.export.c_header import c_header

pytestmark = pytest.mark.train

runner, simulate = programs("runner", "simulate")
OK, HELD, LATE, FALLEN, STOPPED, STARTING = 0, 2, 3, 4, 5, 6
FLAGS = ("-std=c99", "-O2", "-pedantic", "-Wall", "-Wextra", "-Werror")
START, STEPS = 60, 200  # the control step of the fault, and the steps of an episode
DRIVER = Path(__file__).with_name("policy_updates.c")
NEEDS_CC = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")


@pytest.fixture(scope="module")
def bundle(trained, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exported") / "bundle"
    succeed("export", trained.run.path, "-o", folder)
    # Wheel speeds from the latest gravity, pitch rate, wheel speeds, actions, and distance; a search found the gains.
    replace_network(folder, [27, 13, 93, 94, 123, 124, 133], [18.8, 7.36, 4.5, 4.5, 0.1125, 0.1125, 1.54])
    return folder


def replace_network(folder: Path, columns: list[int], weights: list[float]) -> None:
    """Write a bundle's policy anew, with a linear network that drives both wheels alike."""
    weight = np.zeros((6, 135), np.float32)
    weight[4:, columns] = weights
    arrays = {"weight_0": weight, "bias_0": np.zeros(6, np.float32)}
    np.savez(folder / "policy.npz", **arrays)
    spec = json.loads((folder / "policy.json").read_text())
    spec["network"] |= {"widths": [6], "activations": ["identity"], "normalized": False}
    spec["safety"]["readings"]["commands.base_velocity"]["high"][0] = 0.05  # The small training had no speeds.
    (folder / "policy.json").write_text(json.dumps(spec))
    (folder / "policy.h").write_text(c_header(spec, arrays))
    shutil.copy(DRIVER, folder / "driver.c")


class Loop:
    """The robot of the bundle under ``Policy.update``, with all inputs and outputs for a comparison with C."""

    def __init__(self, folder: Path, startup: bool = False) -> None:
        self.folder, self.startup = folder, startup
        self.policy = runner.Policy(folder)
        self.policy.begin(startup)
        self.robot, self.mujoco = simulate.Robot(self.policy.spec, folder / "robot" / "scene.xml"), simulate.mujoco
        self.gains = self.robot.model.actuator_gainprm.copy(), self.robot.model.actuator_biasprm.copy()
        self.dt, self.steps = self.policy.spec["step_dt"], 0
        self.targets: dict | None = None
        self.inputs: list[tuple] = []
        self.outputs: list[dict] = []
        self.upright: list[float] = []

    def readings(self) -> dict:
        found = self.robot.readings({"base_velocity": np.array([0.02, 0.0, 0.0])})
        wanted = [name for name in self.policy.spec["readings"] if name in found]
        return {name: np.array(found[name]) for name in (*wanted, "base_quat")}

    def step(self, change: Callable | None = None, held_up: bool = False) -> None:
        """Advance by one control step; ``change`` returns other inputs, or None to miss the step."""
        given = (self.readings(), self.steps * self.dt, self.steps * self.dt)
        given = given if change is None else change(*given)
        if given is not None:
            self.update(*given)
        model, data = self.robot.model, self.robot.data
        for now, full in zip((model.actuator_gainprm, model.actuator_biasprm), self.gains, strict=True):
            now[:] = full * self.targets["gain"]
        for _ in range(self.policy.spec["decimation"]):
            self.robot.drive(self.targets)
            self.mujoco.mj_step(model, data)
        if held_up:  # A person holds the base.
            data.qpos[:7] = [*self.policy.spec["root"]["pos"], *self.policy.spec["root"]["quat"]]
            data.qvel[:6] = 0.0
        self.steps += 1
        self.upright.append(self.robot.upright)

    def update(self, readings: dict, time: float, now: float) -> None:
        self.targets = self.policy.update(readings, time, now)
        self.inputs.append((readings, time, now))
        self.outputs.append(self.targets | {"steps": self.policy.steps, "commands": self.policy.commands})

    @property
    def statuses(self) -> list[int]:
        return [found["status"] for found in self.outputs]

    def check(self) -> None:
        """Require finite targets within the limits, and the same from C."""
        spec = self.policy.spec
        rows = np.stack([self.row(found) for found in self.outputs])
        assert np.isfinite(rows).all()
        position, velocity, effort = (
            rows[:, 3 : 3 + 3 * len(spec["joint_names"])].reshape(len(rows), 3, -1).transpose(1, 0, 2)
        )
        assert 0 <= rows[:, 1].min() <= rows[:, 1].max() <= 1
        low, high = np.array(spec["joint_pos_limits"][:4], np.float32).T
        assert ((position[:, :4] >= low) & (position[:, :4] <= high)).all()
        assert (np.abs(velocity) <= spec["velocity_limit"]).all()
        assert (np.abs(effort) <= spec["effort_limit"]).all()
        if shutil.which("cc"):
            found = self.in_c()
            np.testing.assert_array_equal(found[:, 0], rows[:, 0])
            assert (np.abs(found - rows) / np.maximum(1, np.abs(rows))).max() <= 1e-5
            if self.policy.bump is not None:
                np.testing.assert_allclose(found[:, -4:], rows[:, -4:], atol=1e-6, err_msg="commands")

    def row(self, found: dict) -> np.ndarray:
        targets = [found[name] for name in ("position", "velocity", "effort")]
        commands = [] if self.policy.bump is None else [*(found["commands"].values() or [[0.0] * 4])]
        numbers = [found["status"], found["gain"], found["steps"]]
        return np.concatenate([numbers, *targets, *commands]).astype(np.float32)

    def in_c(self) -> np.ndarray:
        """Return status, gain, and targets of ``policy_update`` for the same inputs."""
        if not (self.folder / "driver").exists():
            command = ["cc", *FLAGS, self.folder / "driver.c", "-o", self.folder / "driver", "-lm"]
            subprocess.run(command, check=True, timeout=PATIENCE_S)
        sent = b""
        for readings, time, now in self.inputs:
            values = [np.array([round(1e6 * value) for value in (time if time == time else now + 9, now)], np.int64)]
            values.append(numbers([9.0] * 4 if "projected_gravity" in readings else readings["base_quat"], 4))
            values += [numbers(readings.get(n), r["width"]) for n, r in self.policy.spec["readings"].items()]
            sent += b"".join(value.tobytes() for value in values)
        command = [self.folder / "driver", *["startup"] * self.startup]
        said = subprocess.run(command, input=sent, capture_output=True, check=True, timeout=PATIENCE_S)
        return np.frombuffer(said.stdout, np.float32).reshape(len(self.inputs), -1)


@np.errstate(all="ignore")
def numbers(value: object, width: int) -> np.ndarray:
    """Return a reading as float32, and NaN for a missing one."""
    return np.array([np.nan] * width if value is None or isinstance(value, str) else value, np.float32)


def put(name: str, value: object, *columns: int) -> Callable:
    """Return a fault that overwrites a reading, or only some columns of it."""

    def change(readings, *times):
        new = np.array(readings.get(name, [0.0, 0.0, -1.0]), float)
        new[list(columns)] = value if columns else new[[]]
        return readings | {name: new if columns else value}, *times

    return change


def add(name: str, value: float, column: int) -> Callable:
    return lambda readings, *times: put(name, readings[name][column] + value, column)(readings, *times)


def lose_all(readings, *times):
    return dict.fromkeys(readings), *times


NAN, PI2 = np.nan, 2 * np.pi
STOPS = [HELD] * 3 + [STOPPED]  # more than ``hold_steps`` bad readings
BACK = [STOPPED, OK]  # after a stop: good readings for ``stopped_s``, 2 steps
# Each fault: its number of control steps, its change of the inputs, and the statuses from its first step on.
FAULTS: dict[str, tuple[int, Callable, list[int]]] = {
    "gyroscope NaN": (3, put("base_ang_vel", [NAN] * 3), [HELD] * 3 + [OK]),
    "one speed NaN": (3, put("joint_vel", NAN, 3), [HELD] * 3 + [OK]),
    "command NaN for good": (130, put("commands.base_velocity", [NAN] * 3), [HELD] * 130),
    "command beyond its range": (130, put("commands.base_velocity", [9.0, 0.0, 0.0]), [OK] * 130),
    "joint beyond its stop": (1, put("joint_pos", 1.95, 0), [HELD, OK]),
    "encoder starts from another angle": (140, add("joint_pos", 2.0, 4), [HELD, OK]),
    "wheel encoder wraps for good": (130, add("joint_pos", -PI2, 5), [OK] * 130),
    "leg encoder wraps for one sample": (1, add("joint_pos", PI2, 2), [OK, OK]),
    "two joints exchanged": (1, lambda r, *t: (r | {"joint_pos": r["joint_pos"][[2, 1, 0, 3, 4, 5]]}, *t), [HELD, OK]),
    "lost for 3 steps": (3, lose_all, [HELD] * 3 + [OK]),
    "lost for 10 steps": (10, lose_all, STOPS + [STOPPED] * 6 + BACK),
    "one reading lost for 5 steps": (5, put("joint_vel", None), [*STOPS, STOPPED, *BACK]),
    "text": (1, put("base_ang_vel", "none"), [HELD, OK]),
    "old timestamp": (5, lambda r, t, n: (r, (START - 1) / 60, n), [OK, OK, *[HELD] * 3, OK]),
    "same time again": (2, lambda r, t, n: (r, (START - 1) / 60, (START - 1) / 60), [HELD, HELD, LATE, OK]),
    "time NaN": (1, lambda r, t, n: (r, NAN, n), [HELD, OK]),
    "1 missed step": (1, lambda *_: None, [LATE, OK]),
    "5 missed steps": (5, lambda *_: None, [STOPPED, *BACK]),
    "clock back by 2 steps": (1, lambda r, t, n: (r, t - 2 / 60, n - 2 / 60), [HELD, LATE, OK]),
    "clock back by 1 s": (1, lambda r, t, n: (r, t - 1.0, n - 1.0), [HELD, STOPPED, *BACK]),
    "zero quaternion": (1, put("base_quat", [0.0] * 4), [HELD, OK]),
    "quaternion of length 1.4": (1, put("base_quat", [1.4, 0.0, 0.0, 0.0]), [OK, OK]),
    "upside-down for one sample": (1, put("base_quat", [0.0, 1.0, 0.0, 0.0]), [HELD, OK]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_gives_the_documented_statuses_and_the_robot_stands_2_s_later(name, bundle):
    steps, change, expected = FAULTS[name]
    loop = Loop(bundle)
    loop.robot.data.qvel[4] = 0.5  # The base pitches, so that the fault meets a moving robot.
    for step in range(STEPS):
        loop.step(change if START <= step < START + steps else None)
    assert loop.statuses[:START] == [OK] * START
    assert loop.statuses[START : START + len(expected)] == expected
    assert set(loop.statuses[START + len(expected) :]) <= {OK}
    assert min(loop.upright[-30:]) > np.cos(0.1)
    if "missed" in name and STOPPED not in expected:
        assert loop.policy.steps == STEPS
    loop.check()


TICK = 16_667  # µs, a control step


def tilted(cosine: np.float32) -> np.ndarray:
    """Return gravity in the axes of a robot that is tilted about x by the angle of this cosine."""
    return np.array([0.0, (1.0 - float(cosine) ** 2) ** 0.5, -cosine], np.float32)


def up_to(bound: float, end: float = np.inf) -> tuple[np.float32, np.float32]:
    """Return the float32 of a bound and the next float32 towards ``end``, which is beyond the bound."""
    return np.float32(bound), np.nextafter(np.float32(bound), np.float32(end))


def boundaries(spec: dict) -> Iterator[tuple[str, list[tuple[int, int, dict]], list[int]]]:
    """Yield a name, the frames after ten good ones, and their statuses.

    A frame is the time since the previous update (µs), the age of its readings (µs), and other readings than those of
    a robot at rest. Each name has a frame at the boundary, and one a float or a microsecond beyond.
    """
    rules = spec["safety"]
    bound = {name: [np.float32(v or 0) for v in rule["high"]] for name, rule in rules["readings"].items()}
    moved = rules["readings"]["joint_pos"]["max_jump"][4]
    for name, column, limit in (
        ("base_ang_vel", 2, bound["base_ang_vel"][2]),
        ("joint_vel", 1, bound["joint_vel"][1]),
        ("joint_vel", 4, bound["joint_vel"][4]),
        ("joint_pos", 4, moved),
        ("projected_gravity", 2, 1.5),
        ("projected_gravity", 2, 0.5),
    ):
        for sign in (-1,) if name == "projected_gravity" else (1, -1):
            inside, beyond = up_to(sign * limit, 0.0 if limit == 0.5 else sign * np.inf)
            for value, status in ((inside, OK), (beyond, HELD)):
                changed = {name: {column: value}}
                after = changed if status == OK else {}
                yield f"{name} {value!r}", [(TICK, 0, changed), (TICK, 0, after)], [status, OK]
    for side in ("low", "high"):  # A joint moves to its last plausible position, and one float further.
        inside, beyond = up_to(rules["readings"]["joint_pos"][side][0], np.inf if side == "high" else -np.inf)
        way = np.linspace(spec["default_joint_pos"][0], inside, 30, dtype=np.float32)
        frames = [(TICK, 0, {"joint_pos": {0: value}}) for value in (*way, beyond, inside)]
        yield f"joint_pos to its {side} bound", frames, [OK] * 30 + [HELD, OK]
    largest, smaller = up_to(2.0**64, 0.0)
    for value, status in ((smaller, OK), (largest, HELD)):
        yield f"command {value!r}", [(TICK, 0, {"commands.base_velocity": {0: value}})], [status]
    for count, status in ((rules["hold_steps"], HELD), (rules["hold_steps"] + 1, STOPPED)):
        lost = [(TICK, 0, {"joint_vel": {0: NAN}})] * count
        yield f"{count} lost readings", lost, [HELD] * (count - 1) + [status]
    missed = rules["missed_steps"] + 1
    for elapsed, status in (
        (TICK // 2, HELD),
        (TICK // 2 + 1, OK),
        (TICK + TICK // 2, OK),
        (TICK + TICK // 2 + 1, LATE),
        (missed * TICK + TICK // 2, LATE),
        (missed * TICK + TICK // 2 + 1, STOPPED),
    ):
        yield f"{elapsed} µs after the last update", [(elapsed, 0, {})], [status]
    stale = round(1e6 * rules["stale_s"])
    for age, status in ((stale, OK), (stale + 1, HELD), (-TICK, OK), (-TICK - 1, HELD)):
        yield f"readings of an age of {age} µs", [(TICK, age, {})], [status]
    steps = rules["fall"]["steps"]
    at, beyond = up_to(np.cos(rules["fall"]["angle"]), -1.0)
    lean = [(TICK, 0, {"projected_gravity": tilted(np.float32(cosine))}) for cosine in (0.95, 0.8, 0.65)]
    for cosine, count, status in ((at, steps, OK), (beyond, steps - 1, OK), (beyond, steps, FALLEN)):
        down = [(TICK, 0, {"projected_gravity": tilted(cosine)})] * count
        yield f"cosine {cosine!r} for {count} steps", [*lean, *down], [OK] * (2 + count) + [status]
    stop, wait = ((missed + 1) * TICK, 0, {}), round(rules["recover"]["stopped_s"] / spec["step_dt"])
    at, beyond = up_to(np.cos(rules["recover"]["angle"]), -1.0)
    for cosine, status in ((at, OK), (beyond, STOPPED)):
        rest = [(TICK, 0, {"projected_gravity": tilted(cosine)})] * wait
        yield f"upright to {cosine!r}", [stop, *rest], [STOPPED] * wait + [status]
    for value, status in zip(up_to(rules["readings"]["joint_vel"]["slow"]), (OK, STOPPED), strict=True):
        rest = [(TICK, 0, {"joint_vel": {5: value}})] * wait
        yield f"slow to {value!r}", [stop, *rest], [STOPPED] * wait + [status]


def test_both_programs_agree_at_each_boundary(bundle):
    for name, frames, statuses in boundaries(json.loads((bundle / "policy.json").read_text())):
        loop, now = Loop(bundle), 0
        rest = {"base_ang_vel": np.zeros(3), "projected_gravity": np.array([0.0, 0.0, -1.0])}
        rest |= {"joint_pos": np.array(loop.policy.spec["default_joint_pos"]), "joint_vel": np.zeros(6)}
        rest |= {"commands.base_velocity": np.zeros(3)}
        for elapsed, age, changes in [(TICK, 0, {})] * 10 + frames:
            now += elapsed
            readings = {key: np.array(value, np.float32) for key, value in rest.items()}
            for key, values in changes.items():
                for column, value in values.items() if isinstance(values, dict) else enumerate(values):
                    readings[key][column] = value
            loop.update(readings, (now - age) / 1e6, now / 1e6)
        assert loop.statuses == [OK] * 10 + statuses, name
        loop.check()


@pytest.mark.parametrize("startup", [False, True])
def test_random_garbage_never_gives_targets_beyond_the_limits(startup, bundle):
    loop, rng = Loop(bundle, startup), np.random.default_rng(0)

    def garbage(readings, time, now):
        for name in rng.choice([n for n in readings if n != "base_quat"], 2):
            values = [*rng.normal(0, 10.0 ** rng.integers(-2, 30), 4), NAN, np.inf, 0.0, PI2]
            column = rng.integers(len(readings[name]))
            readings = put(str(name), rng.choice(values), int(column))(readings, time, now)[0]
        late = rng.choice([0.0, 0.0, 0.02, -0.05, 3.0])
        return readings, time - rng.choice([0.0, 0.0, 0.1]), now + late

    for step in range(600):
        loop.step(garbage if step % 100 > 80 else None, held_up=step < 300)
    assert set(loop.statuses) >= ({STARTING} if startup else {OK, HELD, LATE, STOPPED})
    loop.check()


@pytest.fixture(scope="module")
def jumping(bundle, tmp_path_factory) -> Path:
    """The bundle with a jump command, and with a trigger that makes the robot jump after a bump."""
    folder = shutil.copytree(bundle, tmp_path_factory.mktemp("jumping") / "bundle")
    (folder / "driver").unlink(missing_ok=True)
    spec = json.loads((folder / "policy.json").read_text())
    spec["readings"]["commands.jump"] = {"width": 1, "unit": "1", "meaning": "a jump"}
    rules = spec["safety"]["readings"]
    rules["commands.jump"] = rules["commands.base_velocity"] | {"low": [0.0], "high": [1.0], "max_jump": [None]}
    rules["commands.base_velocity"] |= {"low": [-0.5] * 3, "high": [0.5] * 3}
    spec["bump"] = {
        **{"on": True, "jump": "commands.jump", "velocity": "commands.base_velocity", "columns": [4, 5]},
        **{"signs": [1.0, -1.0], "wheel_radius": 0.02, "max_acceleration": [1.5, None, 3.0]},
    }
    seconds = {"window_s": 0.3, "height": 0.0, "stopped_s": 0.06, "wait_s": 0.1, "before_s": 0.11}
    spec["bump"]["settings"] = seconds | {"stopped_share": 0.35, "back": 0.2, "run_up": 0.3}
    (folder / "policy.json").write_text(json.dumps(spec))
    with np.load(folder / "policy.npz") as arrays:
        (folder / "policy.h").write_text(c_header(spec, dict(arrays)))
    return folder


@pytest.mark.parametrize("name", [*thinned(FAULTS, 3), "the user stops and returns", "the user wants a jump"])
def test_a_robot_jumps_onto_a_step_after_a_bump_and_after_a_fault(name, jumping):
    loop, place, rolled, phases = Loop(jumping), 0.0, 0.0, []
    steps, change, _ = FAULTS.get(name, (30, put("commands.base_velocity", [0.0, 0.0, 0.2]), []))
    change = put("commands.jump", [1.0]) if "wants" in name else change
    for step in range(900):
        time = loop.steps * loop.dt
        readings = {"base_ang_vel": np.zeros(3), "base_quat": np.array([1.0, 0.0, 0.0, 0.0])}
        readings |= {"joint_pos": np.array(loop.policy.spec["default_joint_pos"])}
        readings |= {"joint_vel": np.array([0.0, 0.0, 0.0, 0.0, rolled / 0.02, -rolled / 0.02])}
        readings |= {"commands.base_velocity": np.array([0.2, 0.0, 0.1]), "commands.jump": np.zeros(1)}
        given = (readings, time, time)
        given = change(*given) if START <= step < START + steps else given
        loop.steps += 1
        if given is not None:
            loop.update(*given)
            phases.append(loop.policy.bump.phase)
        speed, jump = (found[0] for found in loop.policy.commands.values() or [[0.0], [0.0]])
        blocked = speed > 0 and 0.04 <= place < 0.06 and not jump
        rolled = 0.0 if blocked else rolled + 0.5 * (speed - rolled)
        place += rolled * loop.dt
    assert phases[START - 1] == runner.BACK
    assert place > 0.5, "the robot is on the step"
    assert phases[-1] == runner.FOLLOW
    loop.check()


def test_a_fallen_robot_stops_softly_and_runs_again_after_it_was_held_upright(bundle):
    loop = Loop(bundle)
    for _ in range(START):
        loop.step()
    loop.robot.data.qvel[4] = 25.0
    while loop.statuses[-1] == OK and loop.steps < 200:
        before = loop.targets
        loop.step()
    assert loop.statuses[-1] == FALLEN
    for _ in range(40):
        loop.step()
    ramp = np.array([found["gain"] for found in loop.outputs[-41:]])
    np.testing.assert_allclose(ramp[:30], 1 - 0.8 * np.arange(1, 31) / 30, atol=1e-6)  # 0.5 s at 60 Hz
    np.testing.assert_allclose(ramp[30:], 0.2, atol=1e-6)
    halfway = loop.outputs[-41 + 14]
    np.testing.assert_allclose(halfway["velocity"], before["velocity"] / 2, atol=1e-4)
    np.testing.assert_allclose(loop.targets["velocity"], 0.0)
    np.testing.assert_allclose(loop.targets["position"][:4], loop.policy.spec["default_joint_pos"][:4], atol=1e-6)
    assert set(loop.statuses[-40:]) == {FALLEN}
    lifted = loop.steps
    while loop.statuses[-1] == FALLEN and loop.steps < lifted + 200:
        loop.step(held_up=True)
    assert loop.steps - lifted >= 60, "fallen_s"
    for _ in range(120):
        loop.step()
    assert (loop.statuses[-1], loop.targets["gain"]) == (OK, 1.0)
    assert min(loop.upright[-30:]) > np.cos(0.1)
    loop.check()


def test_the_start_up_rests_lifts_and_runs(bundle):
    loop = Loop(bundle, startup=True)
    pose = [0.5, 0.5, -1.0, -1.0, 40.0, 2.0]
    loop.robot.data.qpos[loop.robot.qpos] = pose
    moving = put("joint_vel", 0.6, 0)  # not still
    while loop.steps < 400 and OK not in loop.statuses:
        loop.step(moving if loop.steps < 60 else None, held_up=True)
    gains = np.array([found["gain"] for found in loop.outputs])
    assert loop.statuses[:-1] == [STARTING] * (loop.steps - 1)
    first = int(np.argmax(gains > 0))  # The legs swing before they rest for 1 s, and the fault lasts for 60 steps.
    speeds = [np.abs(readings["joint_vel"]).max() for readings, *_ in loop.inputs[: first + 1]]
    assert first >= 119
    assert max(speeds[first - 59 :]) <= 0.5 < speeds[first - 60]
    np.testing.assert_allclose(gains[first : first + 120], np.arange(1, 121) / 120, atol=1e-6)  # 2 s
    np.testing.assert_allclose(loop.outputs[0]["position"], pose, atol=1e-6)
    lifted = loop.outputs[first + 119]["position"]
    np.testing.assert_allclose(lifted[:4], loop.policy.spec["default_joint_pos"][:4], atol=1e-6)
    for _ in range(120):
        loop.step()
    assert set(loop.statuses[-120:]) == {OK}
    assert min(loop.upright[-30:]) > np.cos(0.1)
    loop.check()


def test_a_network_whose_output_is_too_large_stops_the_robot(bundle, tmp_path):
    replace_network(shutil.copytree(bundle, tmp_path / "bundle"), [27], [1e30])
    (tmp_path / "bundle" / "driver").unlink(missing_ok=True)
    loop = Loop(tmp_path / "bundle")
    loop.robot.data.qpos[3:7] = [0.999, 0.0, 0.04, 0.0]
    loop.step()
    assert loop.statuses == [STOPPED]
    loop.check()


@pytest.mark.parametrize("builder", ["cmake", "cc"])
@NEEDS_CC
def test_the_example_prints_the_log_of_the_runner(builder, bundle, tmp_path):
    if shutil.which(builder) is None:
        pytest.skip(f"there is no {builder}")
    program, example = tmp_path / "policy_example", bundle / "example"
    commands = {
        "cmake": [["cmake", "-S", example, "-B", tmp_path], ["cmake", "--build", tmp_path]],
        "cc": [["cc", "-std=c99", f"-I{bundle}", example / "main.c", "-o", program, "-lm"]],
    }
    for command in commands[builder]:
        subprocess.run(command, check=True, capture_output=True, timeout=PATIENCE_S)
    lines = (example / "readings.csv").read_text().splitlines()
    lines[5] = lines[5].split(",")[0] + "," * lines[5].count(",")  # All readings of a step are missing.
    del lines[8]
    (tmp_path / "faults.csv").write_text("\n".join(lines) + "\n")
    said = subprocess.run([program, tmp_path / "faults.csv"], capture_output=True, text=True, timeout=PATIENCE_S)
    found = list(csv.reader(said.stdout.splitlines()))
    policy = runner.Policy(bundle)
    policy.begin(startup=False)
    single = runner.Policy(bundle)
    log = runner.Log(tmp_path / "log.csv", policy)
    for line in lines[1:]:
        time, *values = [float(field or "nan") for field in line.split(",")]
        ends = np.cumsum([known["width"] for known in policy.spec["readings"].values()])
        readings = dict(zip(policy.spec["readings"], np.split(values, ends[:-1]), strict=True))
        log.write(time, readings, policy.update(readings, time))
        if time < 0.05:  # without faults, the same as ``step``
            np.testing.assert_array_equal(policy.sent["velocity"], single.step(readings)["velocity"])
    with (tmp_path / "log.csv").open() as file:
        wanted = list(csv.reader(file))
    assert found[0] == wanted[0][:-1]
    assert wanted[0][-1] == "reset"
    columns = {"time", "joint_pos.l01", "base_ang_vel.x", "commands.base_velocity.0", "target_velocity.r03"}
    assert columns < set(found[0])
    assert [row[-1] for row in wanted[1:]] == ["1"] + ["0"] * (len(wanted) - 2)
    np.testing.assert_allclose(np.array(found[1:], float), np.array(wanted[1:], float)[:, :-1], rtol=1e-5, atol=1e-5)
    statuses = [int(row[found[0].index("status")]) for row in found[1:]]
    assert (statuses[4], statuses[7], sum(statuses)) == (HELD, LATE, HELD + LATE)
    assert subprocess.run([program, "none.csv"], capture_output=True, timeout=PATIENCE_S).returncode == 1
