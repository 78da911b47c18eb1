"""The policy of this bundle in NumPy: sensor readings in, joint targets out.

    policy = Policy()                      # the folder of this file
    policy.reset()                         # when an episode begins
    targets = policy.step({"base_ang_vel": ..., "base_quat": ..., "joint_pos": ..., "commands.<name>": ...})

Call ``step`` every ``step_dt`` seconds. In ``policy.json``, ``readings`` lists the width and unit of each sensor
reading, and ``joint_names`` the joint order. README.md explains the remaining keys. ``python runner.py`` compares the
actions of this program with actions recorded in the training's simulation. ``python runner.py --onnx`` checks
``policy.onnx``, with the package onnxruntime or onnx.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

F = np.float32
LARGEST = 2.0**64  # Sensor readings above 2**64 are rejected, because their float32 sums could overflow.
ACTIVATIONS: dict[str, Callable[..., Any]] = {
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


def array(values: Any, missing: float = 0.0) -> np.ndarray:
    """Convert a JSON list of numbers to a float32 array; replace each null by ``missing``."""
    return np.array([missing if value is None else value for value in values], F)


def projected_gravity(quat: Any) -> np.ndarray:
    """Return the unit vector of gravity in the frame of a link; ``quat`` (w, x, y, z) is the link's orientation."""
    w, x, y, z = np.asarray(quat, np.float64) / np.linalg.norm(quat)
    return np.array([2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1], F)


class Term:
    """One term of the observation: its value, then modifiers, clip, scale and history."""

    def __init__(self, spec: Mapping[str, Any], step_dt: float) -> None:
        self.spec, self.dt = spec, step_dt
        self.columns = spec.get("columns")
        self.arrays = {key: array(spec[key]) for key in ("subtract", "middle", "range", "scale") if key in spec}
        self.length = max(1, spec["history_length"])

    def reset(self) -> None:
        """Clear an observation term's history and modifier states at the start of an episode."""
        self.history: np.ndarray | None = None  # The first sample after a reset fills the whole observation history.
        self.memory: dict[int, list[np.ndarray]] = {}

    def value(self, readings: Mapping[str, np.ndarray], action: np.ndarray, steps: int) -> np.ndarray:
        """Return the value of an observation term before its modifiers; ``steps`` counts the steps since the reset."""
        spec, kind, time = self.spec, self.spec["function"], F(steps) * F(self.dt)
        if kind == "last_action":
            return action[self.columns]
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

    def travelled(self, readings: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return the robot's measured minus commanded distance (m) and heading (rad), clipped to maximum errors."""
        command = readings[self.spec["command"]][[0, 2]]
        total, before = self.memory.get(-1, [np.zeros(2, F), command])
        if -1 in self.memory:  # In the first step after a reset, the robot's distance and heading errors are 0.
            forwards = readings["joint_vel"][self.columns] * array(self.spec["signs"])
            missed = array([np.mean(forwards) * F(self.spec["wheel_radius"]), readings["base_ang_vel"][2]]) - before
            most = array([self.spec["max_travel_error"], self.spec["max_heading_error"]])
            total = np.clip(total + missed * F(self.dt), -most, most)
        self.memory[-1] = [total, command]
        return total

    def modified(self, number: int, spec: Mapping[str, Any], x: np.ndarray) -> np.ndarray:
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
        y = ins @ forward - outs @ feedback
        self.memory[number] = [ins, np.concatenate((y[:, None], outs), axis=1)[:, : len(feedback)]]
        return y

    def sample(self, readings: Mapping[str, np.ndarray], action: np.ndarray, steps: int) -> np.ndarray:
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


class Policy:
    """The policy with its memory: histories, last action, filters, moving averages.

    If ``onnx`` is true, ``policy.onnx`` is run by onnxruntime, or by onnx.reference without onnxruntime.
    ``observation`` is the last input of the policy's network, before normalisation. ``action`` is the last output of
    the policy's network, clipped as in training.
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
        self.default = array(self.spec["default_joint_pos"])
        self.rolling = np.array([name in self.spec["rolling_joints"] for name in self.spec["joint_names"]], bool)
        self.reset()

    def reset(self) -> None:
        """Start an episode: the next sensor readings fill all histories, and wheel angles count from these readings."""
        self.steps = 0
        self.zero = np.zeros(len(self.default))  # ``zero`` is each wheel's angle at the reset minus its default angle.
        self.action = np.zeros(self.spec["action_width"], F)
        self.averages: dict[str, np.ndarray] = {}
        for term in (term for terms in self.groups for term in terms):
            term.reset()

    def step(self, readings: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return targets ``position`` (rad), ``velocity`` (rad/s), and ``effort`` (N·m) of the J joints, (J,) each.

        ``readings`` contains the current value of each sensor reading and each command, by name. ``base_quat`` (w, x,
        y, z) can replace the reading ``projected_gravity``. If a sensor reading is missing or not finite, ``step``
        raises ValueError and does not change the policy's state.
        """
        self.observation = self.observe(readings)
        self.action = self.network(self.observation)
        return self.act(readings["joint_pos"])

    def observe(self, readings: Mapping[str, Any]) -> np.ndarray:
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

    def network(self, observation: np.ndarray) -> np.ndarray:
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

    def clipped(self, actions: np.ndarray) -> np.ndarray:
        """Return the policy network's actions, clipped to the limits of the training."""
        bound = self.spec["clip_actions"]
        return actions if bound is None else np.clip(actions, F(-bound), F(bound))

    def act(self, joint_pos: Any) -> dict[str, np.ndarray]:
        """Return the joint targets for the last action of the policy, and update the moving averages of the actions."""
        self.steps += 1
        self.processed = [self.process(term, self.counted(joint_pos)) for term in self.spec["actions"]]
        return self.targets(joint_pos)

    def counted(self, joint_pos: Any) -> np.ndarray:
        """Return the joint positions (J,) that the policy observes: angles of wheel joints count from the reset."""
        return (np.asarray(joint_pos, float) - self.zero).astype(F)

    def process(self, term: Mapping[str, Any], joint_pos: np.ndarray) -> np.ndarray:
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

    def targets(self, joint_pos: Any) -> dict[str, np.ndarray]:
        """Return the targets of all joints; a relative action is added to the joint's position in ``joint_pos``.

        Target positions of joints are clipped to the joint limits. Target velocities are clipped to the velocity limits
        of the motor drives.
        """
        found = {"position": self.default.copy(), "velocity": np.zeros_like(self.default)}
        found["effort"] = np.zeros_like(self.default)
        for term, x in zip(self.spec["actions"], self.processed, strict=True):
            ids = term["joint_ids"]
            found[term["drives"]][ids] = x + self.counted(joint_pos)[ids] if term["function"] == "relative" else x
        found["position"] = np.clip((found["position"] + self.zero).astype(F), *self.bounds)
        found["velocity"] = np.clip(found["velocity"], -self.limit, self.limit)
        return found


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


def largest_difference(found: Any, wanted: np.ndarray) -> float:
    """Return the largest value of |found - wanted| / max(1, |wanted|) for two arrays."""
    return float(np.max(np.abs(found - wanted) / np.maximum(1.0, np.abs(wanted)), initial=0.0))


def main(words: list[str]) -> int:
    """Print the differences from ``check.npz``; return exit status 1 if a difference exceeds its tolerance, else 0."""
    limits = json.loads((Path(__file__).parent / "policy.json").read_text(encoding="utf-8"))["check"]
    status = 0
    for name, difference in check(onnx="--onnx" in words).items():
        rounds = "--onnx" in words or name == "actions_float32"
        limit = limits["tolerance_float32" if rounds else "tolerance"]
        print(f"{name}: largest difference {difference:.2g}, at most {limit:g}")
        status |= not difference <= limit
    return int(status)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
