"""Export a policy as a LEAPP bundle: an ONNX graph from sensor readings to joint targets, and its description in YAML.

Runtimes for ros2_control, such as NVIDIA's Isaac ROS Deploy, read it: https://nvidia-isaac.github.io/leapp
"""

from __future__ import annotations

import logging
import shutil
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.export.bundle import runner
from wheelleg_exp.jobs.export.bundle_check import READING, within_tolerances
from wheelleg_exp.jobs.export.exported_observations import COMMANDS, reading
from wheelleg_exp.jobs.export.policy_json import ActionTerm, Modifier, ObservationTerm, PolicyJson, Robot
from wheelleg_exp.mdp.commands import UniformVelocityCommand
from wheelleg_exp.mdp.root_motion import Link

if TYPE_CHECKING:
    import leapp

_NODE, _GRAVITY, _ACTION, _XYZ = "policy", "projected_gravity", "last_action", ("x", "y", "z")
# ``_KINDS`` maps each reading, without its sensor, to LEAPP's kind and its elements; () means the robot's joints.
_KINDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "joint_pos": ("state/joint/position", ()),
    "joint_vel": ("state/joint/velocity", ()),
    "joint_effort": ("state/joint/effort", ()),
    "ang_vel": ("state/body/angular_velocity", _XYZ),
    "lin_vel": ("state/body/linear_velocity", _XYZ),
    "lin_acc": ("state/body/linear_acceleration", _XYZ),
    "quat": ("state/body/rotation", (*_XYZ, "w")),
}
_TWIST = ("command/body/velocity", ("lin_vel_x", "lin_vel_y", "ang_vel_z"))


def leapp_readings(spec: Robot) -> dict[str, str]:
    """Map each input of a LEAPP bundle to its reading; an orientation replaces a projected gravity, as in Isaac Lab."""
    names = ["base_quat" if name == _GRAVITY else name.replace(f".{_GRAVITY}", ".quat") for name in spec["readings"]]
    return {name.replace(".", "_"): name for name in names}


def write_leapp(
    folder: Path, spec: PolicyJson, env: ManagerBasedRLEnv, network: torch.nn.Module, recorded: Mapping[str, np.ndarray]
) -> tuple[dict[str, float], list[str]]:
    """Write a LEAPP bundle; return its largest difference from the recorded targets, and a note per unknown reading.

    ``network`` maps observations (1, O) to actions (1, A). A difference beyond the tolerance raises SimulationFailure.
    """
    import leapp

    def port(name: str, value: torch.Tensor, kind: str | None, elements: Sequence[str] = ()) -> object:
        names = list(elements or spec["joint_names"]) if kind else None
        return leapp.TensorSemantics(name, value, kind=kind, element_names=names)

    notes, inputs = [], {}
    logging.getLogger("leapp").setLevel(logging.CRITICAL)  # leapp also raises each error that it logs.
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")
        leapp.start(_NODE, save_path=str(folder))
        try:
            for key, name in leapp_readings(spec).items():
                kind, elements = _KINDS.get(name.rpartition(".")[2].removeprefix("base_"), (None, ()))
                if name.startswith(COMMANDS):
                    term = env.command_manager.get_term(name.removeprefix(COMMANDS))
                    kind, elements = _TWIST if isinstance(term, UniformVelocityCommand) else (None, ())
                notes += [] if kind else [f"a LEAPP kind for the input `{key}`: the runtime must know its name"]
                inputs[name] = leapp.annotate.input_tensors(_NODE, port(key, 0 * reading(name).of(env), kind, elements))
            step = ControlStep(leapp.annotate, spec, inputs)
            outputs = [port(f"target_{name}", x, f"target/joint/{name}") for name, x in step.targets(network).items()]
            gains = [port("kp", _row(spec["stiffness"]), "kp"), port("kd", _row(spec["damping"]), "kd")]
            leapp.annotate.update_state(_NODE, step.new)
            leapp.annotate.output_tensors(_NODE, outputs, static_outputs=gains, export_with="onnx-torchscript")
        finally:
            leapp.stop()
        leapp.ExportManager().set_save_path(str(folder))  # instead of leapp's own folder, which contains only its log
        configs = leapp.GraphConfigs(frequency=1 / spec["step_dt"], extra={"run": spec["run"]})
        leapp.compile_graph(visualize=False, validate=False, graph_configs=configs)
    shutil.rmtree(folder / _NODE)
    difference = _difference(leapp.InferenceManager(str(folder / f"{_NODE}.yaml")), spec, recorded)
    return within_tolerances({"leapp": difference}), notes


def _difference(policy: leapp.InferenceManager, spec: PolicyJson, recorded: Mapping[str, np.ndarray]) -> float:
    """Return the largest relative difference of the bundle's targets from the recorded ones, after recorded actions."""
    worst = 0.0
    for step, starts in enumerate(recorded["reset"]):
        if starts:
            policy.reset()
        inputs = {f"{_NODE}/{_ACTION}_in": torch.tensor(recorded["actions"][step - 1] * ~starts)[None]}
        for key in policy.inputs:
            name = leapp_readings(spec)[key.removeprefix(f"{_NODE}/")]
            value = torch.tensor(recorded[READING + name][step])[None]
            inputs[key] = torch.roll(value, -1, 1) if name.endswith("quat") else value
        found = policy.run_policy(inputs)
        for kind, wanted in zip(("position", "velocity", "effort"), recorded["targets"][step], strict=True):
            value = found.get(f"{_NODE}/target_{kind}", torch.zeros(1))
            worst = max(worst, runner.largest_difference(value.numpy(), wanted))
    return worst


def _row(values: Iterable[np.floating | float | None], missing: float = 0.0) -> torch.Tensor:
    return torch.from_numpy(runner.array(values, missing))[None]


def _within(x: torch.Tensor, low: Iterable[float | None], high: Iterable[float | None]) -> torch.Tensor:
    return torch.clamp(x, _row(low, -np.inf), _row(high, np.inf))


class ControlStep:
    """One control step of a policy, on tensors (1, n) that leapp traces; ``runner.Policy`` computes the same in NumPy.

    All state is 0 at the start of an episode, because some runtimes ignore initial values; ``new`` is the next state.
    """

    def __init__(self, annotate: Any, spec: PolicyJson, readings: Mapping[str, torch.Tensor]) -> None:
        self._annotate, self._spec, self._readings = annotate, spec, dict(readings)
        self.new: dict[str, torch.Tensor] = {}
        self._steps = self._state("steps", 1)
        self._first = self._steps < 1.0
        self._action = self._state(_ACTION, spec["action_width"])
        for name in (name for name in readings if name.endswith("quat")):
            self._readings[name] = torch.roll(readings[name], 1, 1)  # from (x, y, z, w), the order of ROS
            w, x, y, z = torch.split(torch.nn.functional.normalize(self._readings[name], dim=1), 1, 1)
            gravity = torch.cat((2 * (w * y - x * z), -2 * (w * x + y * z), 2 * (x * x + y * y) - 1), 1)
            self._readings[name.removesuffix("base_quat").replace(".quat", ".") + _GRAVITY] = gravity

    def _state(self, name: str, *shape: int, start: torch.Tensor | None = None) -> torch.Tensor:
        """Return what the previous control step stored in ``new``, or ``start`` in the first step of an episode."""
        stored: torch.Tensor = self._annotate.state_tensors(_NODE, {name: torch.zeros(1, *shape)})
        return stored if start is None else torch.where(self._first, start, stored)

    def targets(self, network: torch.nn.Module) -> dict[str, torch.Tensor]:
        """Return the targets of all joints: ``position``, and ``velocity`` and ``effort`` if an action drives them."""
        spec, default = self._spec, _row(self._spec["default_joint_pos"])
        measured = counted = self._readings["joint_pos"]
        if spec["rolling_joints"]:  # The angles of wheels count from the first reading of an episode.
            rolling = torch.tensor([name in spec["rolling_joints"] for name in spec["joint_names"]])
            start = self.new["start_joint_pos"] = self._state("start_joint_pos", len(rolling), start=measured)
            counted = self._readings["joint_pos"] = torch.where(rolling, measured - start + default, measured)
        pieces: list[torch.Tensor] = []
        for group in spec["observations"]:
            parts = [self._sample(f"{group['name']}_{term['name']}", term) for term in group["terms"]]
            parts = [torch.cat(parts, 2)] if group["history_order"] == "time" else parts
            pieces += [part.flatten(1) for part in parts]
        bound = runner.array([spec["clip_actions"]], np.inf)
        action = _within(network(torch.cat(pieces, 1)), -bound, bound)
        self.new |= {_ACTION: action, "steps": self._steps + 1.0}
        found = {"position": default}
        for term in spec["actions"]:
            x = self._processed(term, action[:, term["start"] : term["stop"]])
            x = x + counted[:, term["joint_ids"]] if term["function"] == "relative" else x
            before = found.get(term["drives"], torch.zeros_like(default))
            found[term["drives"]] = torch.index_copy(before, 1, torch.tensor(term["joint_ids"]), x)
        low, high = zip(*spec["joint_pos_limits"], strict=True)
        found["position"] = _within(found["position"] + (measured - counted), low, high)
        if "velocity" in found:
            most = runner.array(spec["velocity_limit"], np.inf)
            found["velocity"] = _within(found["velocity"], -most, most)
        return found

    def _sample(self, name: str, term: ObservationTerm) -> torch.Tensor:
        """Return the history (1, length, width) of an observation term, with the oldest sample first."""
        x, older = self._value(name, term), term["history_length"] - 1
        for number, modifier in enumerate(term["modifiers"]):
            x = self._modified(f"{name}_modifier_{number}", modifier, x)
        x = x if term["clip"] is None else x.clamp(*term["clip"])
        history = (x * _row(term["scale"]) if "scale" in term else x)[:, None]
        if older > 0:
            history = torch.cat((self._state(f"{name}_history", older, term["width"], start=history), history), 1)
            self.new[f"{name}_history"] = history[:, 1:]
        return history

    def _value(self, name: str, term: ObservationTerm) -> torch.Tensor:
        kind, time = term["function"], self._steps * self._spec["step_dt"]
        if kind in ("time", "remaining_time"):
            return time if kind == "time" else term["episode_length_s"] - time
        if kind in ("travel_error", "height_error"):
            columns, most = [0], np.array([term.get("max_height_error")])
            if kind == "height_error":
                moved = self._height(term)
            else:
                speeds = (self._readings["joint_vel"][:, term["columns"]] * _row(term["signs"])).mean(1, keepdim=True)
                moved = torch.cat((speeds * term["wheel_radius"], self._readings["base_ang_vel"][:, 2:3]), 1)
                columns, most = [0, 2], np.array([term["max_travel_error"], term["max_heading_error"]])
            missed = (moved - self._state(f"{name}_command", len(most), start=moved)) * self._spec["step_dt"]
            total = self.new[f"{name}_total"] = _within(self._state(f"{name}_total", len(most)) + missed, -most, most)
            command = self.new[f"{name}_command"] = self._readings[term["command"]][:, columns]
            return total if kind == "travel_error" else torch.cat((moved - command, total), 1)
        if kind == "gait_phase":
            cycles = self._steps * (self._spec["step_dt"] / term["period"]) + _row(term["offsets"])
            x = 2 * np.pi * torch.fmod(cycles, 1.0)
        else:
            x = self._action if kind == "last_action" else self._readings[term["reading"]]
        x = x[:, term["columns"]] if "columns" in term else x
        if kind == "minus_default":
            return x - _row(term["subtract"])
        if kind == "within_limits":
            return 2 * (x - _row(term["middle"])) / _row(term["range"])
        if kind == "roll_pitch":
            gx, gy, gz = torch.split(x, 1, 1)
            return torch.cat((torch.atan2(-gy, -gz), torch.asin(gx.clamp(-1, 1))), 1)
        return torch.cat((torch.sin(x), torch.cos(x)), 1) if kind in ("sin_cos", "gait_phase") else x

    def _height(self, term: ObservationTerm) -> torch.Tensor:
        points = torch.tensor(term["centres"])[None]
        for link in term["links"]:
            joint = Link(**{key: torch.tensor(value) for key, value in link.items()})
            points = joint.move(points, self._readings["joint_pos"])
        below = (points * self._readings["projected_gravity"][:, None]).sum(2).mean(1, keepdim=True)
        return below + term["wheel_radius"]

    def _modified(self, name: str, spec: Modifier, x: torch.Tensor) -> torch.Tensor:
        if spec["kind"] in ("scale", "bias"):
            return x * spec["multiplier"] if spec["kind"] == "scale" else x + spec["value"]
        if spec["kind"] == "clip":
            return x.clamp(*spec["bounds"])
        if spec["kind"] == "integrator":
            total, before = (self._state(f"{name}_{part}", x.shape[1]) for part in ("total", "input"))
            self.new |= {f"{name}_total": total + (x + before) / 2 * spec["dt"], f"{name}_input": x}
            return self.new[f"{name}_total"]
        # The state of a digital filter stores its inputs and outputs, with the newest input and output first.
        forward, feedback = _row(spec["B"]), _row(spec["A"] or [0.0])
        inputs = self._state(f"{name}_inputs", x.shape[1], forward.shape[1])
        outputs = self._state(f"{name}_outputs", x.shape[1], feedback.shape[1])
        inputs = torch.cat((x[..., None], inputs[..., :-1]), 2)
        y = (inputs * forward).sum(2) - (outputs * feedback).sum(2)
        self.new |= {f"{name}_inputs": inputs, f"{name}_outputs": torch.cat((y[..., None], outputs[..., :-1]), 2)}
        return y

    def _processed(self, term: ActionTerm, raw: torch.Tensor) -> torch.Tensor:
        """Return the joint targets (1, n) of one action term for its actions (1, n)."""
        if term["function"] == "binary":
            above = raw > term["threshold"] if term["strict"] else raw >= term["threshold"]
            x = torch.where(above if term["opens_above"] else ~above, _row(term["open"]), _row(term["close"]))
        else:
            x = raw * _row(term["scale"]) + _row(term["offset"])
        if term["clip"] is not None:
            x = _within(x, *zip(*term["clip"], strict=True))
        if term.get("rescale"):
            low, high = _row(term["low"]), _row(term["high"])
            x = (low + high) / 2 + x.clamp(-1, 1) * ((high - low) / 2)
        if "alpha" in term:  # The moving average of joint targets starts at the current joint positions.
            name, start = f"{term['name']}_average", self._readings["joint_pos"][:, term["joint_ids"]]
            last = self._state(name, x.shape[1], start=start)
            x = self.new[name] = _within(last + _row(term["alpha"]) * (x - last), term["low"], term["high"])
        return x
