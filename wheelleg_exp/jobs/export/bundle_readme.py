"""Write the README of a bundle: its files, how to use them, and the robot's joints, readings, and terms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from wheelleg_exp.jobs.export.policy_json import ActionTerm, Check, Limits, ObservationGroup, PolicyJson

_FILES = {
    "policy.json": "everything between sensor readings and joint targets, as numbers",
    "runner.py": "the policy in NumPy, one file: `Policy().update(readings, time) -> targets`",
    "policy.npz": "the network's arrays, float32, for `runner.py`",
    "policy.onnx": "the network: `obs` (B, O) to `actions` (B, A), before clipping; its metadata hold `policy.json`",
    "policy.pt": "the same as TorchScript",
    "policy.h": "the same policy in C99, one file; `example/main.c` shows its use",
    "example/main.c": "runs `policy.h` on `example/readings.csv`: `cmake -S example -B build && cmake --build build && "
    "build/policy_example example/readings.csv`",
    "example/CMakeLists.txt": "builds `main.c`; `-DPOLICY_FLOAT=ON` for computers without double numbers",
    "example/readings.csv": "readings of a recorded episode, in the layout of a robot log",
    "check.npz": "readings, observations, actions and targets of training's own simulation, with which "
    "`python runner.py` compares each step",
    "simulate.py": "the robot in MuJoCo: `python simulate.py --seconds 20 --view`; needs numpy and mujoco, `--onnx` "
    "also onnxruntime or onnx, `--view` also a display",
    "chirps.py": "moves one joint after another, for `wheelleg identify`: `python chirps.py LOG.csv` simulates",
    "robot/robot.xml": "the robot that was simulated, with its meshes",
    "robot/scene.xml": "the same with training's drives, friction and solver on level ground",
}
_USE = """```python
from runner import Log, Policy

policy = Policy()              # Policy(onnx=True) runs policy.onnx, with onnxruntime or onnx
policy.begin()                 # start-up; begin(startup=False) runs the policy at once, as in a simulation
log = Log("log.csv", policy)   # optional: the robot log
targets = policy.update({...}, time)  # every step_dt: targets["position"] (rad), ["velocity"] (rad/s), ["effort"] (N·m)
log.write(time, {...}, targets)       # targets["gain"]: multiply the drives' stiffness and damping; targets["status"]
```

`update` accepts any readings, and returns finite targets within the limits of joints and drives. `policy.step` (in C
`policy_step`) is the policy alone: a reading that is NaN, inf or missing raises ValueError (in C `POLICY_NOT_FINITE`),
changes nothing, and the caller must decide what the drives do."""


_BUMP = """With `policy.bump.on = True` (in C `guard.jumps_after_bump = 1`), `update` makes the robot jump onto a step
that stopped its wheels: drive back, run up, jump. `update` then limits the acceleration of the command, and a jump
command above 0 starts a jump. The section `bump` of `policy.json` has the settings; `on` is the value after `begin`."""


def _safety(spec: PolicyJson) -> list[str]:
    """Return the sections about start-up, bad readings, falls, and the control rate."""
    rules, codes = spec["safety"], spec["safety"]["status"]
    start, stop, recover, fall = rules["start"], rules["stop"], rules["recover"], rules["fall"]
    hold, missed, hz = rules["hold_steps"], rules["missed_steps"], rules["rate_hz"]
    fallen = "no reading shows the tilt, so falls are not detected"
    if fall is not None:
        fallen = f"tilted by more than {fall['angle']:.3g} rad for {fall['steps']} control steps; safe stop"
    meaning = {
        "ok": "the policy runs",
        "held": f"a reading is bad: the policy gets its last good value, for at most {hold} control steps; after that, "
        "a bad command becomes 0",
        "late": f"1 to {missed} control steps were missed; the policy runs once",
        "fallen": fallen,
        "stopped": f"a reading was bad for more than {hold} control steps, or more than {missed} steps were missed; "
        "safe stop",
        "starting": "start-up: the policy does not run yet",
        "not_finite": "returned only by `policy_step` in C",
    }
    bounds = [
        (f"`{name}`", _bounds(rule["low"]), _bounds(rule["high"]), _bounds(rule["max_jump"]), rule["check"])
        for name, rule in rules["readings"].items()
    ]
    steps = (
        f"Rest: lay the robot on the ground and do not touch it. The gain is 0. The phase lasts until all readings are "
        f"good and still for {start['rest_s']:g} s.",
        f"Lift: hold the robot upright with its wheels on the ground. In {start['lift_s']:g} s, the joints move to "
        "their default positions and the gain rises to 1.",
        f"Hold the robot upright and still for {start['upright_s']:g} s.",
        "Run: when the status is `ok`, let go. Wheel angles count from here, and the memory of the policy is empty.",
    )
    return [
        "## Safety\n\n`update` uses the numbers of the section `safety` of `policy.json`. In C they are constants, "
        "which compiler options such as `-DPOLICY_HOLD_STEPS=5` override.",
        _table(("status", "number", "meaning"), [(f"`{key}`", codes[key], text) for key, text in meaning.items()]),
        "### Start-up\n\n" + "\n".join(f"{number}. {text}" for number, text in enumerate(steps, 1)),
        f"### Safe stop\n\nIn {stop['ramp_s']:g} s, velocity and effort targets ramp to 0, position targets to "
        f"`stop.position`, and the gain to {stop['gain']:g}. The policy resumes when all readings are good, the tilt "
        f"is below {recover['angle']:.3g} rad, and the robot is slow (`slow` of each reading), for "
        f"{recover['stopped_s']:g} s after `stopped` and {recover['fallen_s']:g} s after `fallen`. Then the memory of "
        f"the policy is empty, and the gain rises to 1 in {recover['gain_ramp_s']:g} s. To prevent that, switch the "
        "drives off or call `begin`.",
        f"### Time\n\nCall `update` at {hz:.4g} Hz; half a step of jitter is allowed. `time` is when the sensors took "
        "the readings. A driver that gives old values a new time hides a lost sensor. All readings are bad if they are "
        f"older than {1000 * rules['stale_s']:.4g} ms, or if the time did not advance by half a step. The drives "
        "themselves must stop if no targets arrive.",
        "### Bad readings\n\nA reading is bad if it is missing, not finite, outside its bounds, or changes in one "
        "control step by more than the largest jump. Commands are clipped to their range in training. Unit vectors are "
        "normalised if their length is within `norm`. An encoder angle that jumps by a multiple of 2π is unwrapped. "
        "Targets of joints with limits are always within the limits, so the drives of these joints must unwrap too. "
        "Targets of joints without limits count like the encoder.",
        _table(("reading", "low", "high", "largest jump", "check"), bounds),
        "### Log\n\n`Log` writes one row per control step: `time`, a column for each number of the readings and "
        "targets (`joint_pos.<joint>`, `base_ang_vel.x`, `target_velocity.<joint>`), `status`, `gain`, and "
        "`reset`, which is 1 in the first step of an episode.",
    ]


def _bounds(limits: Limits) -> str:
    return " ".join(dict.fromkeys(map(_number, limits)))


def readme(spec: PolicyJson, files: Sequence[str], notes: Sequence[str]) -> str:
    """Return the README text of a bundle; ``spec`` is the content of ``policy.json``."""
    about, joints = spec["run"], spec["joint_names"]
    drives: list[Sequence[float | None]] = [spec["default_joint_pos"], spec["stiffness"], spec["damping"]]
    drives += [spec["effort_limit"], spec["velocity_limit"]]
    mechanics = [spec["armature"], spec["inertia"], spec["friction"], spec["viscous_friction"], spec["drive_rate"]]
    parts = [
        f"# The policy `{about['task']}` of run `{about['id']}`, iteration {about['iteration']}",
        "Sensor readings in, joint targets out, every "
        f"{1000 * spec['step_dt']:.4g} ms ({1 / spec['step_dt']:.4g} Hz). Nothing here needs torch or the program that "
        "trained it. SI units and radians; quaternions are (w, x, y, z); the base's x axis points forwards, z upwards.",
        "## Files",
        _table(("file", "what it is"), [(f"`{name}`", _FILES[name]) for name in _FILES if name in files]),
        *(f"Not here: {note}." for note in notes),
        "## Use",
        _USE,
        *_safety(spec),
        _checked(spec["check"]),
        "## Readings, in the order of `policy.json`",
        _table(
            ("name", "width", "unit", "what it is"),
            [(f"`{name}`", r["width"], r["unit"], r["meaning"]) for name, r in spec["readings"].items()],
        ),
        *_commands(spec["commands"]),
        *_accelerations(spec["command_accelerations"]),
        "" if spec["bump"] is None else _BUMP,
        "## Joints, in order",
        _table(
            ("#", "joint", "default, rad", "stiffness, N·m/rad", "damping, N·m·s/rad", "effort, N·m", "speed, rad/s"),
            [(i, f"`{joints[i]}`", *(_number(values[i]) for values in drives)) for i in range(len(joints))],
        ),
        "Position targets are clipped to the limits of the joints (`joint_pos_limits`), velocity targets to the speed. "
        "The positions of these joints count from `reset`, independent of their encoder values then: "
        f"{', '.join(f'`{name}`' for name in spec['rolling_joints']) or 'none'}.",
        "## What the robot must have\n\nThe policy was trained with these joints. A robot that differs can fall.",
        _table(
            ("joint", *_UNITS),
            [(f"`{joints[i]}`", *(_number(values[i]) for values in mechanics)) for i in range(len(joints))],
        ),
        "Armature is the rotor's inertia times the gear ratio squared; it adds to the inertia of the parts. The drive "
        "must compute its torque from new encoder values at the drive rate or faster: in each physics step of the "
        "training, and at ten times the rate for stability. With less armature it must do so more often.",
        "## Observation",
        f"{spec['observation_width']} numbers. Each term: its value, its modifiers, `clip`, then `scale`; then the "
        "history. The first readings of an episode fill every slot of it.",
        *_observations(spec["observations"]),
        "The network normalises it: (x - mean) / deviation, arrays of `policy.npz`; the ONNX and TorchScript files do "
        "so themselves."
        if spec["network"]["normalized"]
        else "",
        "## Actions",
        "The network's output is not clipped; as `last_action` the policy sees it unchanged."
        if (bound := spec["clip_actions"]) is None
        else f"The network's output is clipped to ±{bound:g} first; as `last_action` the policy sees it clipped.",
        _table(("action", "joint", "drives", "target"), [*_actions(spec["actions"])]),
        "A joint that no action drives keeps its default position, velocity 0 and effort 0 as targets. Drives hold a "
        "target for the whole control step: torque = stiffness (position - q) + damping (velocity - q̇) + effort, "
        "within the effort limit.",
        *_trained_with(spec),
        *_margins(spec),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


_UNITS = ("armature, kg·m²", "inertia of the parts, kg·m²", "friction, N·m", "damping, N·m·s/rad", "drive rate, Hz")


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in [head, ["---"] * len(head), *rows])


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def _checked(check: Check) -> str:
    rows = [(f"`{name}`", f"{value:.1g}") for name, value in check["largest_difference"].items()]
    return (
        f"Every policy here was compared with {check['steps']} recorded steps, each from the recorded readings, "
        "observation and last action. Differences are relative to max(1, |recorded|). `observations`, `actions` and "
        f"`targets` (`runner.py`) and `c_double` (`policy.h`) agree within {check['tolerance']:g}. `actions_float32` "
        "(the network as in training), `onnx`, `torchscript` and `c_float` have float32 sums, which depend on their "
        f"order: within {check['tolerance_float32']:g}. `python runner.py [--onnx]` repeats the comparison.\n\n"
        + _table(("compared", "largest difference"), rows)
    )


def _commands(commands: Mapping[str, Mapping[str, list[float]]]) -> list[str]:
    lines = [
        f"`commands.{name}`: " + ", ".join(f"{axis} [{low:.4g}, {high:.4g}]" for axis, (low, high) in ranges.items())
        for name, ranges in commands.items()
        if ranges and all(len(pair) == 2 for pair in ranges.values())
    ]
    return ["Trained with these commands (m/s, rad/s): " + "; ".join(lines) + "."] if lines else []


def _accelerations(accelerations: Mapping[str, Sequence[float | None]]) -> list[str]:
    return [
        f"`commands.{name}` starts at rest and changes towards the requested command by at most "
        + ", ".join("any amount" if most is None else f"{most:.4g}" for most in limits)
        + " a second (m/s, m/s, rad/s), as in `simulate.py`: a robot falls if its command jumps to a high speed."
        for name, limits in accelerations.items()
    ]


def _observations(groups: Sequence[ObservationGroup]) -> list[str]:
    lines, start = [], 0
    for group in groups:
        rows = []
        for term in group["terms"]:
            length = max(1, term["history_length"])
            source = f"`{term['reading']}`" if "reading" in term else "-"
            scales = dict.fromkeys(f"{scale:.6g}" for scale in term.get("scale", [1.0]))
            clip = "-" if term["clip"] is None else term["clip"]
            rows.append((f"`{term['name']}`", term["function"], source, term["width"], length, clip, " ".join(scales)))
            start += term["width"] * length
        order = "term by term, each with its history, oldest first"
        if group["history_order"] == "time":
            order = "step by step, oldest first, each step with all terms"
        head = ("term", "value", "of", "width", "samples", "clip", "scale")
        lines += [f"Group `{group['name']}`: {order}.", _table(head, rows)]
    return lines


def _actions(actions: Sequence[ActionTerm]) -> Iterable[tuple[object, ...]]:
    for term in actions:
        for index, joint in enumerate(term["joint_names"]):
            number = term["start"] + min(index, term["stop"] - term["start"] - 1)
            clip = None if term["clip"] is None else term["clip"][index]
            within = "" if clip is None else f", within [{_number(clip[0])}, {_number(clip[1])}]"
            yield number, f"`{joint}`", term["drives"], _law(term, index) + within


def _law(term: ActionTerm, index: int) -> str:
    if term["function"] == "binary":
        return f"{_number(term['open'][index])} or {_number(term['close'][index])}, by a threshold"
    scaled = f"{term['scale'][index]:.6g} a {term['offset'][index]:+.6g}"
    lines = {"relative": f"{scaled} + the joint's position", "affine": scaled}.get(term["function"], scaled)
    if term.get("rescale"):
        lines += f", [-1, 1] spread over [{_number(term['low'][index])}, {_number(term['high'][index])}]"
    return lines + (f", moving average with weight {term['alpha'][index]:.6g}" if "alpha" in term else "")


def _margins(spec: PolicyJson) -> list[str]:
    """Return the section about the largest changes that the policy survived in simulation."""
    head = "## Margins\n\n"
    if not spec["margins"]:
        return [head + "Not measured: run `wheelleg evaluate RUN protocol=robust` before the export."]
    rows = [(row["name"], _number(row["policy"]), _number(row["reference"]), row["unit"]) for row in spec["margins"]]
    text = "The largest changes, each alone, that the policy survived in simulation (`protocol=robust`: by default, in "
    text += "95 % of 128 episodes)."
    return [head + text, _table(("change", "policy", "reference controller", "unit"), rows)]


def _trained_with(spec: PolicyJson) -> list[str]:
    """Return lines about the observation noise and delays of the training, which the exported ``runner.py`` omits."""
    parts = [(f"observation `{t['name']}`", t["trained_with"]) for g in spec["observations"] for t in g["terms"]]
    parts += [(f"action `{term['name']}`", term["trained_with"]) for term in spec["actions"]]
    parts += [(f"drive `{drive['name']}`", drive["trained_with"]) for drive in spec["actuators"]]
    lines = []
    for name, added in parts:
        if delay := added["delay_steps"]:
            low, high = delay
            lines.append(f"- {name}: {low} to {high} physics steps of {1000 * spec['physics_dt']:.4g} ms late")
        if added.get("noise"):
            lines.append(f"- {name}: with noise")
    if not lines:
        return []
    return ["## What training added\n\nThe runner does not: a robot has its own.", "\n".join(lines)]
