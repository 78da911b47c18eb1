"""The policy of this bundle in NumPy: sensor readings in, joint targets out.

    policy = Policy()                      # the folder of this file
    policy.reset()                         # when an episode begins
    targets = policy.step({"base_ang_vel": ..., "base_quat": ..., "joint_pos": ..., "commands.<name>": ...})

Call ``step`` every ``step_dt`` seconds. On a real robot, call ``update`` instead: it starts the robot up, bridges bad
sensor readings, and detects falls. In ``policy.json``, ``readings`` lists the width and unit of each sensor reading,
and ``joint_names`` the joint order. README.md explains the remaining keys. ``python runner.py`` compares the actions of
this program with actions recorded in the training's simulation. ``python runner.py --onnx`` checks ``policy.onnx``,
with the package onnxruntime or onnx.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

F = np.float32
Array = npt.NDArray[Any]
TARGETS = ("position", "velocity", "effort")
TURN = F(2 * np.pi)
OK, NOT_FINITE, HELD, LATE, FALLEN, STOPPED, STARTING = range(7)  # ``safety.status`` of policy.json explains them.
FOLLOW, BACK, RUN_UP, OVER = range(4)  # the phases of ``Bump``
ROUNDING = F(1e-6)
MOST_STEPS = 10_000  # A longer pause counts as this number of control steps.
LARGEST = 2.0**64  # Sensor readings above 2**64 are rejected, because their float32 sums could overflow.
ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0))),
    "relu": lambda x: np.maximum(x, 0.0),
    "leaky_relu": lambda x: np.where(x > 0, x, 0.01 * x),
    "selu": lambda x: 1.0507009873554805 * np.where(x > 0, x, 1.6732632423543772 * np.expm1(np.minimum(x, 0.0))),
    "tanh": np.tanh,
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-x)),
    "softplus": lambda x: np.logaddexp(x, 0.0),
    "swish": lambda x: x / (1.0 + np.exp(-x)),
    "identity": lambda x: x,
}


def array(values: Iterable[np.floating | float | None], missing: float = 0.0) -> Array:
    """Convert a JSON list of numbers to a float32 array; replace each null by ``missing``."""
    return np.array([missing if value is None else value for value in values], F)


def projected_gravity(quat: npt.ArrayLike) -> Array:
    """Return the unit vector of gravity in the frame of a link; ``quat`` (w, x, y, z) is the link's orientation."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], F)


def gravity_or_zeros(quat: object) -> Array:
    """Return ``projected_gravity``; return zeros, a bad reading, if ``quat`` has no length between 0.5 and 1.5."""
    try:
        x = np.array(quat, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(3, F)
    good = x.shape == (4,) and (np.abs(x) < LARGEST).all() and 0.5 <= np.linalg.norm(x) <= 1.5
    return projected_gravity(x) if good else np.zeros(3, F)


class Term:
    """One term of the observation: its value, then modifiers, clip, scale and history."""

    def __init__(self, spec: Any, step_dt: float) -> None:
        self.spec, self.dt = spec, step_dt
        self.columns = spec.get("columns")
        self.arrays = {key: array(spec[key]) for key in ("subtract", "middle", "range", "scale") if key in spec}
        self.length = max(1, spec["history_length"])

    def reset(self) -> None:
        """Clear an observation term's history and modifier states at the start of an episode."""
        self.history: Array | None = None  # The first sample after a reset fills the whole observation history.
        self.memory: dict[int, list[Array]] = {}

    def value(self, readings: Mapping[str, Array], action: Array, steps: int) -> Array:
        """Return the value of an observation term before its modifiers; ``steps`` counts the steps since the reset."""
        spec, kind, time = self.spec, self.spec["function"], F(steps) * F(self.dt)
        if kind == "last_action":
            return np.asarray(action[self.columns])
        if kind == "time":
            return array([time])
        if kind == "remaining_time":
            return array([F(spec["episode_length_s"]) - time])
        if kind == "gait_phase":
            cycles = F(steps) * F(self.dt / spec["period"])
            angles = [F(2 * np.pi) * np.fmod(cycles + F(offset), F(1)) for offset in spec["offsets"]]
            return array([*np.sin(angles), *np.cos(angles)])
        if kind == "travel_error":
            return self.travelled(readings)
        if kind == "height_error":
            return self.height_error(readings)
        x = readings[spec["reading"]]
        x = x if self.columns is None else x[self.columns]
        if kind == "minus_default":
            return x - self.arrays["subtract"]
        if kind == "sin_cos":
            return np.concatenate((np.sin(x), np.cos(x)))
        if kind == "within_limits":
            return F(2) * (x - self.arrays["middle"]) / self.arrays["range"]
        if kind == "roll_pitch":
            return array([np.arctan2(-x[1], -x[2]), np.arcsin(np.clip(x[0], -1, 1))])
        return x

    def travelled(self, readings: Mapping[str, Array]) -> Array:
        """Return the robot's measured minus commanded distance (m) and heading (rad), clipped to maximum errors."""
        forwards = readings["joint_vel"][self.columns] * array(self.spec["signs"])
        rates = array([np.mean(forwards) * F(self.spec["wheel_radius"]), readings["base_ang_vel"][2]])
        most = array([self.spec["max_travel_error"], self.spec["max_heading_error"]])
        return self.integral(rates, readings[self.spec["command"]][[0, 2]], most)

    def integral(self, measured: Array, command: Array, most: Array) -> Array:
        """Return the integral of a measured minus a commanded value within ±most, from 0 after a reset."""
        total, before = self.memory.get(-1, [np.zeros_like(most), measured])
        found: Array = np.clip(total + (measured - before).astype(F) * F(self.dt), -most, most)
        self.memory[-1] = [found, command]
        return found

    def height_error(self, readings: Mapping[str, Array]) -> Array:
        """Return the base's measured minus commanded height (m), and the clipped integral of this error (m·s)."""
        command, points = readings[self.spec["command"]][:1], np.array(self.spec["centres"])  # in the base's frame
        for link in self.spec["links"]:
            axes, anchors, default = (np.array(link[key]) for key in ("axes", "anchors", "default"))
            moved, arm = (readings["joint_pos"][link["columns"]] - default)[:, None], points - anchors
            along = axes * np.sum(axes * arm, axis=1, keepdims=True)
            turned = anchors + along + (arm - along) * np.cos(moved) + np.cross(axes, arm) * np.sin(moved)
            points = np.where(link["slides"], points + axes * moved, turned)
        height = np.mean(points @ readings["projected_gravity"]) + self.spec["wheel_radius"]
        total = self.integral(height, command, array([self.spec["max_height_error"]]))
        return np.concatenate((height - command, total)).astype(F)

    def modified(self, number: int, spec: Any, x: Array) -> Array:
        """Apply an observation modifier to ``x``, and store the modifier's state for the next control step."""
        kind = spec["kind"]
        if kind == "scale":
            return x * F(spec["multiplier"])
        if kind == "bias":
            return x + F(spec["value"])
        if kind == "clip":
            return np.clip(x, F(spec["bounds"][0]), F(spec["bounds"][1]))
        if kind == "integrator":
            total, before = self.memory.get(number, [np.zeros_like(x), np.zeros_like(x)])
            total = total + (x + before) / F(2) * F(spec["dt"])
            self.memory[number] = [total, x]
            return total
        # A digital filter's memory stores its inputs and outputs, with the newest input and output first.
        forward, feedback = array(spec["B"]), array(spec["A"])
        empty = [np.zeros((*x.shape, len(forward)), F), np.zeros((*x.shape, len(feedback)), F)]
        ins, outs = self.memory.get(number, empty)
        ins = np.concatenate((x[:, None], ins[:, :-1]), axis=1)
        y: Array = ins @ forward - outs @ feedback
        self.memory[number] = [ins, np.concatenate((y[:, None], outs), axis=1)[:, : len(feedback)]]
        return y

    def sample(self, readings: Mapping[str, Array], action: Array, steps: int) -> Array:
        """Return an observation term's part of the observation, including the term's history, as a flat array."""
        x = self.value(readings, action, steps)
        for number, spec in enumerate(self.spec["modifiers"]):
            x = self.modified(number, spec, x)
        if self.spec["clip"] is not None:
            x = np.clip(x, F(self.spec["clip"][0]), F(self.spec["clip"][1]))
        x = x * self.arrays["scale"] if "scale" in self.arrays else x
        old = np.repeat(x[None], self.length, axis=0) if self.history is None else self.history
        self.history = np.concatenate((old[1:], x[None]))  # The oldest observation is the first row of ``history``.
        return self.history


class Reading:
    """The checks of one sensor reading or command, described by an entry of ``safety.readings`` in ``policy.json``.

    ``last`` (width,) is the last good value, which the policy gets. ``held`` counts the consecutive control steps with
    a bad value, and ``gap`` the steps since ``last``. ``turns`` (width,) are added to the raw angles of encoders.
    """

    def __init__(self, rule: Any) -> None:
        self.kind, self.norm = rule["check"], rule.get("norm", ())
        self.low, self.high, self.jump = (array(rule[key], np.inf) for key in ("low", "high", "max_jump"))
        self.low = array(rule["low"], -np.inf)
        self.last, self.turns = np.zeros_like(self.low), np.zeros_like(self.low)
        self.held, self.gap = 0, -1  # No good value so far: the gap is negative.

    @np.errstate(all="ignore")
    def accept(self, values: object, steps: int, stale: bool, hold_steps: int) -> None:
        """Check the values of a control step, ``steps`` after the previous ones; store them unless they are bad."""
        try:
            x: Any = np.array(values, F)
        except (TypeError, ValueError, OverflowError):
            x = np.zeros(0, F)
        turns, jumped = self.turns, False
        self.gap = min(self.gap + steps, MOST_STEPS) if self.gap >= 0 else -1
        good = not stale and x.shape == self.last.shape and bool((np.abs(x) < LARGEST).all())
        if good and self.kind == "unit_vector":
            length = np.sqrt(np.sum(x * x, dtype=F))
            good = bool(F(self.norm[0]) <= length <= F(self.norm[1]))
            x = x / length if good and abs(length - 1) > ROUNDING else x  # Good readings are not changed by rounding.
        elif good and self.kind == "command":
            x = np.clip(x, self.low, self.high)
        elif good and self.kind == "encoder":
            x = x + TURN * turns
        if good and self.gap >= 0:
            most = self.jump * F(self.gap)  # A value that persists becomes good, because its gap grows.
            if self.kind == "encoder":  # An encoder's angle that jumps by about a whole turn has wrapped around.
                most = np.minimum(most, F(np.pi))
                wraps = np.where(np.abs(x - self.last) > most, np.floor((x - self.last) / TURN + F(0.5)), F(0))
                x, turns = x - TURN * wraps, turns - wraps
            jumped = bool((np.abs(x - self.last) > most).any())
        good = good and bool(((self.low <= x) & (x <= self.high)).all())
        if good and not jumped:
            self.last, self.turns, self.gap, self.held = x, turns, 0, 0
            return
        self.held = min(self.held + steps, MOST_STEPS)
        if self.kind == "command" and self.held > hold_steps:
            self.last = np.zeros_like(self.last)


class Bump:
    """Drives back from a step that stopped the wheels, runs up to it, and commands a jump, as in the training.

    ``spec`` is the section ``bump`` of ``policy.json``. While ``on`` is false, the policy gets the user's commands.
    """

    def __init__(self, spec: Any, step_dt: float) -> None:
        self.spec, self.step_dt, self.on = spec, step_dt, spec["on"]
        self.numbers = {name: F(value) for name, value in spec["settings"].items()}
        self.reset()

    def reset(self) -> None:
        """Forget the step, and start from a velocity command of 0."""
        self.phase, self.command = FOLLOW, np.zeros(0, F)
        self.way = self.waited = self.slow = self.ahead = self.speed = self.left = F(0)

    def commands(self, readings: Mapping[str, Array], steps: int) -> dict[str, Array]:
        """Return the commands for the policy from those of the user, ``steps`` control steps after the last call.

        The velocity changes by at most ``max_acceleration``. A user's jump command above 0 starts a jump.
        """
        spec, window, asked = self.spec, self.numbers["window_s"], readings[self.spec["velocity"]]
        if not self.on:
            self.reset()
            self.command, self.speed = asked, asked[0]
            return {}
        most = array([np.inf if a is None else a * self.step_dt for a in spec["max_acceleration"]]) * F(steps)
        if len(self.command):
            self.command = self.command + np.clip(asked - self.command, -most, most)
            forwards = np.mean(readings["joint_vel"][spec["columns"]] * array(spec["signs"]))
            self.advance(asked[0], forwards * F(spec["wheel_radius"]), F(self.step_dt) * F(steps), most[0])
        else:
            self.command = np.clip(asked, -most, most)
        self.left = window if readings[spec["jump"]][0] > 0 and not self.left else self.left
        share = self.left / window
        height = self.numbers["height"] * F(self.left > 0)
        return {spec["velocity"]: self.command, spec["jump"]: array([share, height])[: len(readings[spec["jump"]])]}

    def advance(self, asked: Any, rolled: Any, dt: Any, most: Any) -> None:
        """Advance by ``dt`` s; the user wants the speed ``asked``, m/s, and the wheels roll at ``rolled``, m/s."""
        known, way, self.left = self.numbers, np.sign(asked), max(self.left - dt, F(0))
        if way != self.way or (self.phase == OVER and not self.left):
            self.phase = FOLLOW
        self.way, self.ahead = way, self.ahead - way * rolled * dt
        # Wheels that follow a changing command, or that are in the air, are slow, too.
        steady = np.abs(self.wanted(asked) - self.speed) < ROUNDING and not self.left and way
        self.waited = self.waited + dt if steady else F(0)
        slow = np.sign(self.speed) * rolled < known["stopped_share"] * np.abs(self.speed)
        self.slow = self.slow + dt if slow and self.waited > known["wait_s"] else F(0)
        bumped = self.slow >= known["stopped_s"]
        self.waited = F(0) if bumped else self.waited
        if self.phase == BACK and (bumped or self.ahead >= known["back"]):  # or something is behind the robot
            self.phase = RUN_UP
        elif bumped:
            self.phase, self.ahead = BACK, F(0)
        if self.phase == RUN_UP and self.ahead <= known["before_s"] * known["run_up"] and not self.left:
            self.phase, self.left = OVER, known["window_s"]
        self.speed = self.speed + np.clip(self.wanted(asked) - self.speed, -most, most)
        self.command[0] = self.speed
        self.command[2] *= self.phase == FOLLOW  # straight back, and straight to the step

    def wanted(self, asked: Any) -> Any:
        """Return the speed of the present phase, m/s."""
        run_up = np.sign(asked) * self.numbers["run_up"]
        return {FOLLOW: asked, BACK: -run_up}.get(self.phase, run_up)


class Policy:
    """The policy with its memory: histories, last action, filters, moving averages.

    With ``onnx``, ``policy.onnx`` is run by onnxruntime, or else by onnx.reference. ``observation`` and ``action`` are
    the network's last input, before normalisation, and its last output, clipped as in training.
    """

    def __init__(self, folder: str | Path = Path(__file__).parent, onnx: bool = False) -> None:
        self.spec = json.loads((Path(folder) / "policy.json").read_text(encoding="utf-8"))
        self.groups = [[Term(term, self.spec["step_dt"]) for term in g["terms"]] for g in self.spec["observations"]]
        self.session: Any = None
        if onnx:
            try:
                from onnxruntime import InferenceSession as Session
            except ImportError:
                from onnx.reference import ReferenceEvaluator as Session
            self.session = Session(str(Path(folder) / "policy.onnx"))
        with np.load(Path(folder) / "policy.npz") as weights:
            self.weights = {name: weights[name].astype(np.float64) for name in weights.files}
        self.limit = array(self.spec["velocity_limit"], np.inf)
        limits = zip(*self.spec["joint_pos_limits"], strict=True)
        self.bounds = [array(values, missing) for values, missing in zip(limits, (-np.inf, np.inf), strict=True)]
        self.default, self.effort = array(self.spec["default_joint_pos"]), array(self.spec["effort_limit"], np.inf)
        self.free = np.isinf(self.bounds[0]) & np.isinf(self.bounds[1])  # joints without limits, such as wheels
        self.rolling = np.array([name in self.spec["rolling_joints"] for name in self.spec["joint_names"]], bool)
        self.safety = self.spec["safety"]
        self.bump = None if self.spec["bump"] is None else Bump(self.spec["bump"], self.spec["step_dt"])
        self.begin()

    def begin(self, startup: bool = True) -> None:
        """Start the operation of ``update``: with the start-up procedure, or with the policy at once."""
        self.readings = {name: Reading(rule) for name, rule in self.safety["readings"].items()}
        if self.bump is not None:
            self.bump.on = self.spec["bump"]["on"]
        self.phase, self.reason = "rest" if startup else "run", STOPPED
        self.now: int | None = None  # µs, of the previous update
        self.phase_steps = self.calm = self.tilted = 0
        zeros = np.zeros_like(self.default)
        self.sent: dict[str, Any] = {
            "position": self.default,
            "velocity": zeros,
            "effort": zeros,
            "gain": F(not startup),
        }
        self.before = self.sent  # ``before`` is the output at the start of a phase.
        self.reset()

    def reset(self) -> None:
        """Start an episode: the next sensor readings fill all histories, and wheel angles count from these readings."""
        self.steps = 0
        self.zero = np.zeros(len(self.default))  # ``zero`` is each wheel's angle at the reset minus its default angle.
        self.action = np.zeros(self.spec["action_width"], F)
        self.averages: dict[str, Array] = {}
        self.commands: dict[str, Array] = {}  # of ``bump``, which the policy got instead of the user's
        if self.bump is not None:
            self.bump.reset()
        for term in (term for terms in self.groups for term in terms):
            term.reset()

    def step(self, readings: Mapping[str, npt.ArrayLike]) -> dict[str, Array]:
        """Return targets ``position`` (rad), ``velocity`` (rad/s), and ``effort`` (N·m) of the J joints, (J,) each.

        ``readings`` contains each sensor reading and each command by name; ``base_quat`` (w, x, y, z) can replace
        ``projected_gravity``. A missing or non-finite reading raises ValueError and does not change the policy's state.
        """
        self.observation = self.observe(readings)
        self.action = self.network(self.observation)
        return self.act(readings["joint_pos"])

    def observe(self, readings: Mapping[str, npt.ArrayLike]) -> Array:
        """Append the sensor readings of one step to the observation histories, and return the network's observation."""
        found = {name: np.asarray(value, F) for name, value in readings.items()}
        if "projected_gravity" not in found and "base_quat" in found:
            if found["base_quat"].shape != (4,) or not np.isfinite(found["base_quat"]).all():
                raise ValueError("sensor reading 'base_quat' must be 4 finite numbers: w, x, y, z")
            found["projected_gravity"] = projected_gravity(found["base_quat"])
        for name, known in self.spec["readings"].items():
            if name not in found or found[name].shape != (known["width"],):
                raise ValueError(f"sensor reading '{name}' must be {known['width']} numbers: {known['meaning']}")
            if not (np.abs(found[name]) < LARGEST).all():
                raise ValueError(f"sensor reading '{name}' contains a number that is not finite or is too large")
        if self.steps == 0:
            self.zero = np.where(self.rolling, np.asarray(readings["joint_pos"], float) - self.default, 0.0)
        found["joint_pos"] = self.counted(readings["joint_pos"])
        pieces = []
        for terms, group in zip(self.groups, self.spec["observations"], strict=True):
            histories = [term.sample(found, self.action, self.steps) for term in terms]
            if group["history_order"] == "time":  # Order the history by step: all terms of step 1, then all of step 2.
                pieces.append(np.concatenate(histories, axis=1).ravel())
            else:  # term by term
                pieces += [history.ravel() for history in histories]
        return np.concatenate(pieces)

    def network(self, observation: Array) -> Array:
        """Return the action for an observation, clipped as in training; NumPy computes the action in float64."""
        if self.session is not None:
            return self.clipped(self.session.run(None, {"obs": observation[None]})[0][0])
        x = observation.astype(np.float64)
        if "mean" in self.weights:
            x = (x - self.weights["mean"]) / self.weights["deviation"]
        for number, name in enumerate(self.spec["network"]["activations"]):
            x = self.weights[f"weight_{number}"] @ x + self.weights[f"bias_{number}"]
            x = ACTIVATIONS[name](x)
        return self.clipped(x.astype(F))

    def clipped(self, actions: Array) -> Array:
        """Return the policy network's actions, clipped to the limits of the training."""
        bound = self.spec["clip_actions"]
        return actions if bound is None else np.clip(actions, F(-bound), F(bound))

    def act(self, joint_pos: npt.ArrayLike) -> dict[str, Array]:
        """Return the joint targets for the last action of the policy, and update the moving averages of the actions."""
        self.steps += 1
        self.processed = [self.process(term, self.counted(joint_pos)) for term in self.spec["actions"]]
        return self.targets(joint_pos)

    def counted(self, joint_pos: npt.ArrayLike) -> Array:
        """Return the joint positions (J,) that the policy observes: angles of wheel joints count from the reset."""
        return (np.asarray(joint_pos, float) - self.zero).astype(F)

    def process(self, term: Any, joint_pos: Array) -> Array:
        """Return the joint targets of one action term of the policy."""
        raw = self.action[term["start"] : term["stop"]]
        kind = term["function"]
        if kind == "binary":
            above = raw > F(term["threshold"]) if term["strict"] else raw >= F(term["threshold"])
            x = np.where(above if term["opens_above"] else ~above, array(term["open"]), array(term["close"]))
        else:
            x = raw * array(term["scale"]) + array(term["offset"])
        if term["clip"] is not None:
            x = np.clip(x, array([b[0] for b in term["clip"]], -np.inf), array([b[1] for b in term["clip"]], np.inf))
        if kind == "to_limits":
            low, high = array(term["low"], -np.inf), array(term["high"], np.inf)
            if term["rescale"]:
                x = (low + high) / F(2) + np.clip(x, F(-1), F(1)) * ((high - low) / F(2))
            if "alpha" in term:  # The moving average of joint targets starts at the current joint positions.
                last = self.averages.get(term["name"], joint_pos[term["joint_ids"]])
                x = np.clip(last + array(term["alpha"]) * (x - last), low, high)
                self.averages[term["name"]] = x
        return x

    def targets(self, joint_pos: npt.ArrayLike) -> dict[str, Array]:
        """Return the targets of all joints; a relative action is added to the joint's position in ``joint_pos``.

        Positions are clipped to the joint limits, and velocities to the velocity limits of the motor drives.
        """
        found = {"position": self.default.copy(), "velocity": np.zeros_like(self.default)}
        found["effort"] = np.zeros_like(self.default)
        for term, x in zip(self.spec["actions"], self.processed, strict=True):
            ids = term["joint_ids"]
            found[term["drives"]][ids] = x + self.counted(joint_pos)[ids] if term["function"] == "relative" else x
        found["position"] = np.clip((found["position"] + self.zero).astype(F), *self.bounds)
        found["velocity"] = np.clip(found["velocity"], -self.limit, self.limit)
        return found

    def update(self, readings: Mapping[str, npt.ArrayLike], time: float, now: float | None = None) -> dict[str, Any]:
        """Return finite targets within all limits for any readings, as ``step`` does, with ``gain`` and ``status``.

        ``time`` (s) is when the readings were taken, and ``now`` (s, by default ``time``) is the current time of the
        same clock. A missing, stale, implausible, or not finite reading is bad. The drives must multiply stiffness and
        damping by ``gain``, from 0 to 1. ``status`` is a number of ``safety.status`` in ``policy.json``.
        """
        rules, hold = self.safety, self.safety["hold_steps"]
        steps, stale = self.elapsed(time, time if now is None else now)
        if "projected_gravity" not in readings and "base_quat" in readings:
            readings = {**readings, "projected_gravity": gravity_or_zeros(readings["base_quat"])}
        for name, reading in self.readings.items():
            reading.accept(readings.get(name), steps, stale, hold)
        sensors = [reading for reading in self.readings.values() if reading.kind != "command"]
        lost = steps > rules["missed_steps"] + 1 or any(s.held > hold or s.gap < 0 for s in sensors)
        good = not any(s.held or s.gap < 0 for s in sensors)
        upright, fallen = good, False
        if rules["fall"] is not None:
            gravity, up = self.readings[rules["fall"]["reading"]], array(rules["fall"]["upright"])
            cosine = np.sum(gravity.last * up, dtype=F)
            upright = good and bool(cosine >= F(np.cos(rules["recover"]["angle"])))
            if gravity.held == 0:
                tilted = cosine < F(np.cos(rules["fall"]["angle"]))
                self.tilted = min(self.tilted + steps, MOST_STEPS) if tilted else 0
            fallen = self.tilted >= rules["fall"]["steps"]
        self.phase_steps = min(self.phase_steps + steps, MOST_STEPS)
        settled = good and self.below("still") if self.phase == "rest" else upright and self.below("slow")
        self.calm = min(self.calm + steps, MOST_STEPS) if settled else 0
        start = rules["start"]
        lifted = self.phase_steps > self.count(start["lift_s"]) and self.calm >= self.count(start["upright_s"])
        if self.phase == "rest":
            if self.calm >= self.count(start["rest_s"]):
                self.enter("lift")
        elif self.phase == "stop":
            self.reason = FALLEN if fallen else self.reason
            wait = rules["recover"]["fallen_s" if self.reason == FALLEN else "stopped_s"]
            if self.calm >= self.count(wait):
                self.enter("run")
        elif lost or (fallen and self.phase == "run"):
            self.enter("stop", STOPPED if lost else FALLEN)
        elif self.phase == "lift" and lifted:
            self.enter("run")
        status = STARTING if self.phase != "stop" else self.reason
        if self.phase == "run":
            status = HELD if any(r.held for r in self.readings.values()) else LATE if steps > 1 else OK
            self.steps += steps - 1 if self.steps else 0  # Terms such as ``gait_phase`` count the missed steps.
            known = {name: reading.last for name, reading in self.readings.items()}
            self.commands = {} if self.bump is None else self.bump.commands(known, steps)
            found = self.step(known | self.commands)
            found |= {"gain": self.ramped("gain", F(1), rules["recover"]["gain_ramp_s"])}
            found["effort"] = np.clip(found["effort"], -self.effort, self.effort) * found["gain"]
            found["position"] = np.where(self.free, found["position"] - self.turned(), found["position"])
            if all((np.abs(value) < LARGEST).all() for value in (self.action, *found.values())):
                self.sent = found
            else:
                self.enter("stop", STOPPED)
                status = STOPPED
        if self.phase != "run":
            self.sent, self.commands = self.at_rest(), {}
        return {**self.sent, "status": status}

    def at_rest(self) -> dict[str, Any]:
        """Return the outputs of the phases in which the policy does not run; free joints stay where they are."""
        rules, measured = self.safety, np.clip(self.readings["joint_pos"].last, *self.bounds)
        here = np.where(self.free, measured - self.turned(), measured)
        if self.phase == "rest" or self.readings["joint_pos"].gap < 0:
            zeros = np.zeros_like(self.default)
            position = self.default if self.readings["joint_pos"].gap < 0 else here
            return {"position": position, "velocity": zeros, "effort": zeros, "gain": F(0)}
        lifts = self.phase == "lift"
        seconds = rules["start"]["lift_s"] if lifts else rules["stop"]["ramp_s"]
        found = {key: self.ramped(key, F(0), seconds) for key in ("velocity", "effort")}
        pose = self.default if lifts else array(rules["stop"]["position"])
        found["position"] = np.where(self.free, here, np.clip(self.ramped("position", pose, seconds), *self.bounds))
        gain = F(1) if lifts else min(self.before["gain"], F(rules["stop"]["gain"]))
        return found | {"gain": self.ramped("gain", gain, seconds)}

    def ramped(self, key: str, goal: npt.ArrayLike, seconds: float) -> Any:
        """Return an output on its way from the start of the phase to ``goal``, which it reaches after ``seconds``."""
        part = F(min(self.phase_steps, self.count(seconds))) / F(self.count(seconds))
        return self.before[key] + part * (goal - self.before[key])

    def enter(self, phase: str, reason: int = STOPPED) -> None:
        """Start a phase of ``update``: rest, lift, run, or stop; the policy's memory is cleared before it runs."""
        self.phase, self.reason, self.before = phase, reason, self.sent
        self.phase_steps, self.calm = 1, 0
        if phase == "run":
            self.reset()

    def count(self, seconds: float) -> int:
        """Return a duration in control steps, at least 1."""
        return max(1, round(seconds / float(self.spec["step_dt"])))

    def below(self, key: str) -> bool:
        """Return whether all readings that have the bound ``key``, ``still`` or ``slow``, are within that bound."""
        bounds = self.safety["readings"].items()
        return all(np.abs(self.readings[n].last).max() <= F(r[key]) for n, r in bounds if r[key] is not None)

    def turned(self) -> Array:
        """Return the angles (J,) that were added to the raw angles of the encoders."""
        return TURN * self.readings["joint_pos"].turns

    def elapsed(self, time: float, now: float) -> tuple[int, bool]:
        """Return the control steps since the previous update, at least 1, and whether the readings are stale."""
        if not abs(now) < LARGEST:
            return 1, True
        tick, before, us = round(1e6 * self.spec["step_dt"]), self.now, round(1e6 * now)
        self.now, age = us, us - round(1e6 * time) if abs(time) < LARGEST else -2 * tick
        steps = 1 if before is None else (us - before + tick // 2) // tick
        stale = steps < 1 or not -tick <= age <= round(1e6 * self.safety["stale_s"])
        return min(max(steps, 1), MOST_STEPS), stale


class Log:
    """A robot log as CSV: one row per control step with time, readings, targets, status, gain, and reset.

    The readings of the first row define the columns. The fields of a missing reading are empty. Commands are those
    that the policy got.
    """

    def __init__(self, path: str | Path, policy: Policy) -> None:
        self.path, self.policy, self.fields = Path(path), policy, dict[str, list[str]]()

    def write(self, time: float, readings: Mapping[str, npt.ArrayLike], targets: Mapping[str, Any]) -> None:
        """Append the readings of time ``time`` (s), and what ``Policy.update`` returned for them."""
        joints, row, readings = self.policy.spec["joint_names"], [f"{time:.6f}"], {**readings, **self.policy.commands}
        with self.path.open("a" if self.fields else "w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            if "base_quat" in readings and "projected_gravity" not in readings:
                readings = {**readings, "projected_gravity": gravity_or_zeros(readings["base_quat"])}
            if not self.fields:
                widths = {name: known["width"] for name, known in self.policy.spec["readings"].items()}
                widths |= {name: np.size(value) for name, value in readings.items() if name not in widths}
                self.fields = {name: columns(name, width, joints) for name, width in widths.items()}
                names = [name for fields in self.fields.values() for name in fields]
                sent = [f"target_{key}.{joint}" for key in TARGETS for joint in joints]
                rows.writerow(["time", *names, *sent, "status", "gain", "reset"])
            for name, fields in self.fields.items():
                values = np.ravel(readings.get(name, ()))
                row += (
                    ["" if value is None else str(value) for value in values]
                    if len(values) == len(fields)
                    else [""] * len(fields)
                )
            row += [str(value) for key in TARGETS for value in targets[key]]
            starts = self.policy.steps == 1 and targets["status"] in (OK, HELD, LATE)
            rows.writerow([*row, str(int(targets["status"])), str(targets["gain"]), str(int(starts))])


def columns(name: str, width: int, joints: list[str]) -> list[str]:
    """Return the names of a reading's columns in a robot log."""
    if name in ("joint_pos", "joint_vel", "joint_effort"):
        return [f"{name}.{joint}" for joint in joints]
    axes = {"base_ang_vel": "xyz", "projected_gravity": "xyz", "base_quat": "wxyz"}.get(name, range(width))
    return [f"{name}.{axis}" for axis in axes]


def check(folder: str | Path = Path(__file__).parent, onnx: bool = False) -> dict[str, float]:
    """Compare ``Policy`` with the recorded values in ``check.npz``; return the largest difference of each output.

    ``check`` computes observations from recorded readings, actions from recorded observations, and targets from
    recorded actions. ``actions_float32`` is the largest difference from the actions that torch computed in float32.
    """
    policy, worst = Policy(folder, onnx), dict.fromkeys(("observations", "actions", "targets", "actions_float32"), 0.0)
    with np.load(Path(folder) / "check.npz") as file:
        recorded = {name: file[name] for name in file.files}
    names = [name for name in recorded if name.startswith("reading:")]
    for step in range(len(recorded["reset"])):
        if recorded["reset"][step]:
            policy.reset()
        readings = {name.removeprefix("reading:"): recorded[name][step] for name in names}
        found = {"observations": policy.observe(readings), "actions": policy.network(recorded["observations"][step])}
        policy.action = recorded["actions"][step]
        targets = policy.act(readings["joint_pos"])
        found["targets"] = np.stack([targets[name] for name in ("position", "velocity", "effort")])
        for name, value in (found | {"actions_float32": found["actions"]}).items():
            worst[name] = max(worst[name], largest_difference(value, recorded[name][step]))
    return worst


def largest_difference(found: Array | float, wanted: Array) -> float:
    """Return the largest value of |found - wanted| / max(1, |wanted|) for two arrays."""
    return float(np.max(np.abs(found - wanted) / np.maximum(1.0, np.abs(wanted)), initial=0.0))


def main(words: list[str]) -> int:
    """Print the differences from ``check.npz``; return exit status 1 if a difference exceeds its tolerance, else 0."""
    parser = argparse.ArgumentParser(description="compare the policy's outputs with the recorded ones")
    parser.add_argument("--onnx", action="store_true", help="check policy.onnx, with onnxruntime or onnx")
    onnx = parser.parse_args(words).onnx
    limits = json.loads((Path(__file__).parent / "policy.json").read_text(encoding="utf-8"))["check"]
    status = 0
    for name, difference in check(onnx=onnx).items():
        rounds = onnx or name == "actions_float32"
        limit = limits["tolerance_float32" if rounds else "tolerance"]
        print(f"{name}: largest difference {difference:.2g}, at most {limit:g}")
        status |= not difference <= limit
    return int(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
