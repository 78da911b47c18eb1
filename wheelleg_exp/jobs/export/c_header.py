"""Write ``policy.h``: the policy as one C99 header, from sensor readings to joint targets.

In the C code, ``r`` points to sensor readings, ``s`` to the policy's state, and ``v`` to the values of an observation.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from wheelleg_exp.jobs.export.bundle.runner import TARGETS, columns
from wheelleg_exp.jobs.export.policy_json import ActionTerm, Fall, Modifier, ObservationTerm, PolicyJson

_LEAST, _MOST = np.finfo(np.float32).min, np.finfo(np.float32).max
_CHECKS = ("bounds", "unit_vector", "command", "encoder")
_NO_BOUND = 1e30  # a float that no reading reaches; ``inf`` is undefined with -ffast-math


def term_memory(name: str, term: ObservationTerm) -> Iterator[str]:
    """Yield C declarations of the arrays that store an observation term's history and modifier states."""
    yield f"float history_{name}[{term['width'] * max(1, term['history_length'])}];"
    if term["function"] in ("travel_error", "height_error"):
        yield f"float integral_{name}[2], commanded_{name}[2];"
    for number_of, modifier in enumerate(term["modifiers"]):
        if modifier["kind"] == "integrator":
            yield f"float total_{name}_{number_of}[{term['width']}], before_{name}_{number_of}[{term['width']}];"
        if modifier["kind"] == "filter":
            sizes = (term["width"] * len(modifier["B"]), max(1, term["width"] * len(modifier["A"])))
            yield f"float in_{name}_{number_of}[{sizes[0]}], out_{name}_{number_of}[{sizes[1]}];"


def term_lines(name: str, term: ObservationTerm, spec: PolicyJson) -> Iterator[str]:
    """Yield the C lines that compute the value of an observation term and append this value to the term's history."""
    yield f"/* {in_comment(term['name'])} */"
    yield from _value(name, term, float(spec["step_dt"]))
    width = term["width"]
    for number_of, modifier in enumerate(term["modifiers"]):
        yield f"for (i = 0; i < {width}; i++) {_modified(f'{name}_{number_of}', modifier)}"
    if term["clip"] is not None:
        low, high = map(number, term["clip"])
        yield f"for (i = 0; i < {width}; i++) v[i] = policy_clip(v[i], {low}, {high});"
    for i, scale in enumerate(term.get("scale", ())):
        yield f"v[{i}] *= {number(scale)};"
    yield f"policy_remember(s->history_{name}, v, {width}, {max(1, term['history_length'])}, first);"


def action_lines(name: str, term: ActionTerm) -> Iterator[str]:
    """Yield C code that scales, clips, and filters the network's output for one action term."""
    for i, joint in enumerate(term["joint_ids"]):
        out = f"s->processed_{name}[{i}]"
        if "alpha" in term:  # The moving average of joint targets starts at the current joint positions.
            yield "{"
            yield f"    float last = first ? joint_pos[{joint}] - s->zero[{joint}] : {out};"
        yield from (f"    {line}" if "alpha" in term else line for line in _processed(out, term, i))
        if "alpha" in term:
            low, high = number(term["low"][i], "-FLT_MAX"), number(term["high"][i])
            yield f"    {out} = policy_clip(last + {number(term['alpha'][i])} * ({out} - last), {low}, {high});"
            yield "}"


def number(value: float | None, missing: str = "FLT_MAX") -> str:
    """Return a C float: null becomes ``missing``, inf the largest float (-ffast-math does not support inf)."""
    return missing if value is None else f"{float(np.clip(np.float32(value), _LEAST, _MOST))!r}f"


def _processed(out: str, term: ActionTerm, i: int) -> Iterator[str]:
    raw = f"s->action[{term['start'] + min(i, term['stop'] - term['start'] - 1)}]"
    if term["function"] == "binary":
        above = f"{raw} {'>' if term['strict'] else '>='} {number(term['threshold'])}"
        opens = above if term["opens_above"] else f"!({above})"
        yield f"{out} = {opens} ? {number(term['open'][i])} : {number(term['close'][i])};"
    else:
        yield f"{out} = {raw} * {number(term['scale'][i])} + {number(term['offset'][i])};"
    if term["clip"] is not None:
        low, high = term["clip"][i]
        yield f"{out} = policy_clip({out}, {number(low, '-INFINITY')}, {number(high)});"
    if term.get("rescale"):
        bounds = term["low"][i], term["high"][i]
        least, most = (np.float32(np.nan if bound is None else bound) for bound in bounds)
        middle, half = number(float((least + most) / 2)), number(float((most - least) / 2))
        yield f"{out} = {middle} + policy_clip({out}, -1.0f, 1.0f) * {half};"


def _value(name: str, term: ObservationTerm, dt: float) -> Iterator[str]:
    kind, columns = term["function"], term.get("columns")
    time = f"(float)s->steps * {number(dt)}"
    if kind == "last_action":
        yield from (f"v[{i}] = s->action[{column}];" for i, column in enumerate(columns or ()))
    elif kind == "time":
        yield f"v[0] = {time};"
    elif kind == "remaining_time":
        yield f"v[0] = {number(term['episode_length_s'])} - {time};"
    elif kind == "gait_phase":
        offsets = term["offsets"]
        for i, offset in enumerate(offsets):
            cycles = f"(float)s->steps * {number(dt / term['period'])} + ({number(offset)})"
            angle = f"{number(2 * np.pi)} * fmodf({cycles}, 1.0f)"
            yield f"v[{i}] = sinf({angle}); v[{i + len(offsets)}] = cosf({angle});"
    elif kind == "travel_error":
        pairs = zip(term["columns"], term["signs"], strict=True)
        wheels = " ".join(f"{'+' if sign > 0 else '-'} r->joint_vel[{column}]" for column, sign in pairs)
        rates = (f"({wheels}) / {len(term['columns'])}.0f * {number(term['wheel_radius'])}", "r->base_ang_vel[2]")
        bounds = (term["max_travel_error"], term["max_heading_error"])
        for i, (rate, bound, column) in enumerate(zip(rates, bounds, (0, 2), strict=True)):
            yield from _integral(f"{name}[{i}]", rate, bound, f"r->{identifier(term['command'])}[{column}]", dt)
            yield f"v[{i}] = s->integral_{name}[{i}];"
    elif kind == "height_error":
        height, command = f"height_{name}", f"r->{identifier(term['command'])}[0]"
        yield from _height(height, term)
        yield from _integral(f"{name}[0]", f"(float){height}", term["max_height_error"], command, dt)
        yield f"v[0] = (float)({height} - {command}); v[1] = s->integral_{name}[0];"
    else:
        yield from _read(term)


def _integral(place: str, measured: str, bound: float, command: str, dt: float) -> Iterator[str]:
    """Yield C code that integrates a measured minus a commanded value, from 0 in the first step of an episode."""
    total, before = f"s->integral_{place}", f"s->commanded_{place}"
    summed = f"{total} + ({measured} - {before}) * {number(dt)}"
    yield f"if (!first) {total} = policy_clip({summed}, -{number(bound)}, {number(bound)});"
    yield f"{before} = {command};"


def _height(height: str, term: ObservationTerm) -> Iterator[str]:
    """Yield C code that declares and computes the height of the base over the wheels."""
    point = f"{height}_point"
    yield f"policy_real {point}[3], {height} = (policy_real){term['wheel_radius']!r};"
    for wheel, centre in enumerate(term["centres"]):
        yield " ".join(f"{point}[{i}] = (policy_real)({value!r});" for i, value in enumerate(centre))
        for link in term["links"]:
            line = ", ".join(map(repr, (*link["axes"][wheel], *link["anchors"][wheel])))
            angle = f"r->joint_pos[{link['columns'][wheel]}] - (policy_real)({link['default'][wheel]!r})"
            yield f"policy_move({point}, (const policy_real[]){{{line}}}, {angle}, {int(link['slides'][wheel][0])});"
        yield f"for (i = 0; i < 3; i++) {height} += {point}[i] * r->projected_gravity[i] / {len(term['centres'])};"


def _read(term: ObservationTerm) -> Iterator[str]:
    source, columns = f"r->{identifier(term['reading'])}", term.get("columns")
    if term["function"] == "roll_pitch":
        yield f"v[0] = atan2f(-{source}[1], -{source}[2]);"
        yield f"v[1] = asinf(policy_clip({source}[0], -1.0f, 1.0f));"
        return
    count = len(columns) if columns is not None else term["width"]
    for i in range(count):
        x = f"{source}[{i if columns is None else columns[i]}]"
        if term["function"] == "sin_cos":
            yield f"v[{i}] = sinf({x}); v[{i + count}] = cosf({x});"
        elif term["function"] == "minus_default":
            yield f"v[{i}] = {x} - ({number(term['subtract'][i])});"
        elif term["function"] == "within_limits":
            yield f"v[{i}] = 2.0f * ({x} - ({number(term['middle'][i])})) / {number(term['range'][i])};"
        else:
            yield f"v[{i}] = {x};"


def _modified(name: str, modifier: Modifier) -> str:
    """Return C code that applies an observation modifier to ``v[i]``, such as ``v[i] *= 2.0f;``."""
    kind = modifier["kind"]
    if kind == "scale":
        return f"v[i] *= {number(modifier['multiplier'])};"
    if kind == "bias":
        return f"v[i] += {number(modifier['value'])};"
    if kind == "clip":
        low, high = map(number, modifier["bounds"])
        return f"v[i] = policy_clip(v[i], {low}, {high});"
    if kind == "integrator":
        total, before = f"s->total_{name}[i]", f"s->before_{name}[i]"
        added = f"(v[i] + {before}) / 2.0f * {number(modifier['dt'])}"
        return f"{{ {total} += {added}; {before} = v[i]; v[i] = {total}; }}"
    sides = [(side, list(map(number, modifier[side])) or ["0"], len(modifier[side])) for side in ("B", "A")]
    forward, feedback = (f"(const float[]){{{', '.join(words)}}}, {count}" for _, words, count in sides)
    x, y = f"s->in_{name} + i * {sides[0][2]}", f"s->out_{name} + i * {sides[1][2]}"
    return f"v[i] = policy_filter({x}, {y}, {forward}, {feedback}, v[i]);"


def identifier(name: str) -> str:
    """Return ``name`` as a valid C identifier."""
    return re.sub(r"\W", "_", name)


def in_comment(text: str) -> str:
    """Return text that cannot end a C comment: the export compiles the header, and names can come from any file."""
    return text.replace("*", "_")


# ``POLICY_F(exp, x)`` calls ``expf`` in a header with POLICY_REAL=float, because small computers lack double numbers.
_ACTIVATIONS = {
    "elu": "x > 0 ? x : POLICY_F(expm1, x)",
    "relu": "x > 0 ? x : 0",
    "leaky_relu": "x > 0 ? x : (policy_real)0.01 * x",
    "selu": "(policy_real)1.0507009873554805 * (x > 0 ? x : (policy_real)1.6732632423543772 * POLICY_F(expm1, x))",
    "tanh": "POLICY_F(tanh, x)",
    "sigmoid": "1 / (1 + POLICY_F(exp, -x))",
    "softplus": "(x > 0 ? x : 0) + POLICY_F(log1p, POLICY_F(exp, x > 0 ? -x : x))",
    "swish": "x / (1 + POLICY_F(exp, -x))",
    "identity": "x",
}


def c_header(spec: PolicyJson, arrays: Mapping[str, np.ndarray]) -> str:
    """Return the text of ``policy.h`` for the content of ``policy.json`` and the arrays of the policy network."""
    groups = enumerate(spec["observations"])
    terms = [(f"{g}_{t}", term) for g, group in groups for t, term in enumerate(group["terms"])]
    actions = [(str(number), term) for number, term in enumerate(spec["actions"])]
    joints, about = len(spec["joint_names"]), spec["run"]
    update = Path(__file__).with_name("policy_update.h").read_text(encoding="utf-8").rstrip()
    memory = [line for name, term in terms for line in term_memory(name, term)]
    memory += [f"float processed_{name}[{len(term['joint_ids'])}];" for name, term in actions]
    if spec["bump"] is not None:
        memory += ["struct { int phase; float command[3], way, waited, slow, ahead, speed, left; } bump;"]
    observe = [line for name, term in terms for line in term_lines(name, term, spec)]
    processed = [line for name, term in actions for line in action_lines(name, term)]
    return _HEADER.format(
        about=in_comment(f"The policy '{about['task']}' of run {about['id']}, iteration {about['iteration']}."),
        joint_names=_listed(f"{i} {name}" for i, name in enumerate(spec["joint_names"])),
        joints=joints,
        observations=spec["observation_width"],
        actions=spec["action_width"],
        dt=float(spec["step_dt"]),
        rolling=_listed(spec["rolling_joints"]) or "none",
        readings="\n".join(
            f"    float {identifier(name)}[{known['width']}]; /* {known['unit']}: {in_comment(known['meaning'])} */"
            for name, known in spec["readings"].items()
        ),
        memory=_indented(memory),
        constants="\n".join(_constants(spec, arrays)),
        widest=max([spec["observation_width"], *spec["network"]["widths"]]),
        observe=_indented([*observe, *_layout(spec)]),
        normalize=_NORMALIZE if spec["network"]["normalized"] else _COPY,
        zero=_indented(_zero(spec)),
        limits=_indented(_limits(spec)),
        layers=_indented(_layers(spec)),
        clip="" if spec["clip_actions"] is None else _CLIP.format(bound=number(spec["clip_actions"])),
        processed=_indented(processed),
        apply=_indented(_applied(spec)),
        update="\n".join([*update_constants(spec), update]),
    )


def update_constants(spec: PolicyJson) -> Iterator[str]:
    """Yield the constants of ``policy_update.h``."""
    safety, step_us = spec["safety"], round(1e6 * spec["step_dt"])
    start, stop, recover = safety["start"], safety["stop"], safety["recover"]
    unknown: Fall = {"reading": "joint_pos", "upright": [0.0] * len(spec["joint_names"]), "angle": 0.0, "steps": 1}
    fall = safety["fall"] or unknown
    names, rules = list(safety["readings"]), list(safety["readings"].values())
    seconds = {"REST": start["rest_s"], "LIFT": start["lift_s"], "UPRIGHT": start["upright_s"], "RAMP": stop["ramp_s"]}
    seconds |= {"STOPPED": recover["stopped_s"], "FALLEN": recover["fallen_s"], "GAIN": recover["gain_ramp_s"]}
    numbers: dict[str, int | str] = {
        "HOLD_STEPS": safety["hold_steps"],
        "MISSED_STEPS": safety["missed_steps"],
        "FALL_STEPS": fall["steps"],
    }
    numbers |= {"STEP_US": step_us, "STALE_US": round(1e6 * safety["stale_s"])}
    numbers |= {f"{name}_STEPS": max(1, round(value / spec["step_dt"])) for name, value in seconds.items()}
    numbers |= {"STOP_GAIN": _float(stop["gain"]), "RECOVER_COSINE": _float(math.cos(recover["angle"]))}
    numbers |= {"FALL_COSINE": _float(math.cos(fall["angle"]))}
    yield "\n/* The section safety of policy.json. -DPOLICY_HOLD_STEPS=5 and so on override a number. */"
    for name, value in numbers.items():
        yield f"#ifndef POLICY_{name}\n#define POLICY_{name} {value}\n#endif"
    widths = [known["width"] for known in spec["readings"].values()]
    read = [c for n, r in spec["readings"].items() for c in columns(n, r["width"], spec["joint_names"])]
    sent = [f"target_{key}.{joint}" for key in TARGETS for joint in spec["joint_names"]]
    yield f"#define POLICY_NUMBERS {sum(widths)} /* of all readings */"
    yield f"#define POLICY_KINDS {len(rules)} /* of readings */"
    yield f"#define POLICY_ENCODERS {names.index('joint_pos')}"
    yield f"#define POLICY_HAS_TILT {int(safety['fall'] is not None)}"
    yield f"#define POLICY_GRAVITY {names.index(fall['reading'])}"
    yield f"#define POLICY_READING_COLUMNS {_string(','.join(read))}"
    yield f"#define POLICY_TARGET_COLUMNS {_string(','.join(sent))}"
    starts = [sum(widths[:k]) for k in range(len(widths))]
    yield from _bump_constants(spec, dict(zip(names, starts, strict=True)))
    table = zip(starts, widths, (_CHECKS.index(rule["check"]) for rule in rules), strict=True)
    yield "static const int policy_rule[POLICY_KINDS][3] = { /* first number, width, check */"
    yield ",\n".join(f"    {{{a}, {b}, {c}}}" for a, b, c in table) + "};"
    yield _float_array("policy_low", [-_NO_BOUND if v is None else v for rule in rules for v in rule["low"]])
    for key, bounds in (("high", [r["high"] for r in rules]), ("max_jump", [r["max_jump"] for r in rules])):
        yield _float_array(f"policy_{key}", [_NO_BOUND if v is None else v for values in bounds for v in values])
    for key, values in (("still", [r["still"] for r in rules]), ("slow", [r["slow"] for r in rules])):
        yield _float_array(f"policy_{key}", [_NO_BOUND if v is None else v for v in values])
    yield _float_array("policy_norm", [bound for rule in rules for bound in rule.get("norm", (0.0, _NO_BOUND))])
    yield _float_array("policy_upright", fall["upright"])
    yield _float_array("policy_safe_position", stop["position"])
    for side, name in enumerate(("low", "high")):
        ends = [(pair[side], (2 * side - 1) * _NO_BOUND) for pair in spec["joint_pos_limits"]]
        yield _float_array(f"policy_position_{name}", [missing if end is None else end for end, missing in ends])
    yield _float_array("policy_effort_limit", [_NO_BOUND if limit is None else limit for limit in spec["effort_limit"]])


def _bump_constants(spec: PolicyJson, starts: Mapping[str, int]) -> Iterator[str]:
    """Yield the constants of the bump trigger; ``starts`` has the first number of each reading."""
    bump, dt = spec["bump"], spec["step_dt"]
    yield f"#define POLICY_HAS_BUMP {int(bump is not None)}"
    yield f"#define POLICY_BUMP_ON {int(bump is not None and bump['on'])}"
    if bump is None:
        return
    places = {"velocity": starts[bump["velocity"]], "jump": starts[bump["jump"]], "speeds": starts["joint_vel"]}
    places |= {"wheels": len(bump["columns"]), "numbers": spec["readings"][bump["jump"]]["width"]}
    numbers = {**bump["settings"], "dt": dt, "radius": bump["wheel_radius"]}
    yield from (f"#define POLICY_BUMP_{name.upper()} {place}" for name, place in places.items())
    yield from (f"#define POLICY_BUMP_{name.upper()} {_float(value)}" for name, value in numbers.items())
    yield _array("int", "policy_bump_column", map(str, bump["columns"]))
    yield _float_array("policy_bump_sign", bump["signs"])
    yield _float_array("policy_bump_change", [_NO_BOUND if a is None else a * dt for a in bump["max_acceleration"]])


def _float(value: float) -> str:
    return f"{float(value)!r}f"


def _float_array(name: str, values: list[float]) -> str:
    return f"static const float {name}[{len(values)}] = {{{', '.join(map(_float, values))}}};"


def _string(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?").replace("\n", "\\n") + '"'


def _listed(words: Iterable[str]) -> str:
    return ", ".join(map(in_comment, words))


def _indented(lines: Iterable[str]) -> str:
    return "\n".join(f"    {line}" for line in lines)


def _array(kind: str, name: str, values: Iterable[str]) -> str:
    words = list(values)
    lines = ["    " + ", ".join(words[start : start + 10]) for start in range(0, len(words), 10)]
    return f"static const {kind} {name}[{len(words)}] = {{\n" + ",\n".join(lines) + "};"


def _constants(spec: PolicyJson, arrays: Mapping[str, np.ndarray]) -> Iterable[str]:
    yield _array("float", "policy_default_joint_pos", map(number, spec["default_joint_pos"]))
    yield _array("float", "policy_velocity_limit", map(number, spec["velocity_limit"]))
    for name, array in arrays.items():
        kind = "policy_real" if array.dtype == np.float64 else "float"
        words = (repr(float(v)) if kind == "policy_real" else f"{float(v):.9g}" for v in array.ravel())
        # A whole number gets a decimal point, because ``1f`` is invalid C.
        words = (word if any(mark in word for mark in ".en") else f"{word}.0" for word in words)
        yield _array(kind, f"policy_{name}", (word + ("f" if kind == "float" else "") for word in words))


def _layout(spec: PolicyJson) -> Iterable[str]:
    """Yield C code that concatenates the histories of all observation terms into the network's input."""
    yield "next = s->observation;"
    for g, group in enumerate(spec["observations"]):
        lengths = [max(1, term["history_length"]) for term in group["terms"]]
        by_time = group["history_order"] == "time"
        for step in range(lengths[0] if by_time else 1):
            for t, term in enumerate(group["terms"]):
                count = term["width"] * (1 if by_time else lengths[t])
                start = step * term["width"] if by_time else 0
                yield f"memcpy(next, s->history_{g}_{t} + {start}, {count} * sizeof(float)); next += {count};"


def _layers(spec: PolicyJson) -> Iterable[str]:
    network, inputs = spec["network"], spec["observation_width"]
    for k, (width, activation) in enumerate(zip(network["widths"], network["activations"], strict=True)):
        here, there = ("a", "b") if k % 2 == 0 else ("b", "a")
        yield f"for (i = 0; i < {width}; i++) {{"
        yield f"    policy_real x = policy_bias_{k}[i];"
        yield f"    for (j = 0; j < {inputs}; j++) x += policy_weight_{k}[i * {inputs} + j] * {here}[j];"
        yield f"    {there}[i] = {_ACTIVATIONS[activation]};"
        yield "}"
        inputs = width
    result = "b" if len(network["widths"]) % 2 else "a"
    yield f"for (i = 0; i < POLICY_ACTIONS; i++) s->action[i] = (float){result}[i];"


def _zero(spec: PolicyJson) -> Iterable[str]:
    for i in map(spec["joint_names"].index, spec["rolling_joints"]):
        yield f"if (first) s->zero[{i}] = counted.joint_pos[{i}] - policy_default_joint_pos[{i}];"


def _limits(spec: PolicyJson) -> Iterable[str]:
    for i, (low, high) in enumerate(spec["joint_pos_limits"]):
        position = f"out->position[{i}]"
        yield f"{position} = policy_clip({position} + s->zero[{i}], {number(low, '-FLT_MAX')}, {number(high)});"


def _applied(spec: PolicyJson) -> Iterable[str]:
    for place, term in enumerate(spec["actions"]):
        for index, joint in enumerate(term["joint_ids"]):
            relative = f"joint_pos[{joint}] - s->zero[{joint}] + " if term["function"] == "relative" else ""
            yield f"out->{term['drives']}[{joint}] = {relative}s->processed_{place}[{index}];"


_NORMALIZE = "a[i] = (s->observation[i] - (policy_real)policy_mean[i]) / policy_deviation[i];"
_COPY = "a[i] = s->observation[i];"
_CLIP = "    for (i = 0; i < POLICY_ACTIONS; i++) s->action[i] = policy_clip(s->action[i], -{bound}, {bound});\n"
_HEADER = """\
/* {about}
 *
 * Sensor readings in, joint targets out; SI units and radians. Joints in order: {joint_names}.
 *
 *     policy_state state;
 *     policy_reset(&state);                                          when an episode starts
 *     if (policy_step(&state, &readings, &targets)) stop_drives();   every POLICY_STEP_DT seconds
 *
 * policy_step returns POLICY_OK, or POLICY_NOT_FINITE when a reading is NaN, inf, or at least 2^64. It
 * then changes neither state nor targets. Position targets are clipped to the joints' limits, velocity targets to the
 * drives' limits. Rolling joints, whose positions count from policy_reset: {rolling}.
 *
 * On a robot, call policy_begin and policy_update instead: they start the robot up, bridge bad readings for a moment,
 * stop the robot safely, and always give finite targets within all limits. README.md describes them.
 *
 * C99, needs the C library's math. -DPOLICY_REAL=float uses single precision and no double function.
 */
#ifndef POLICY_H
#define POLICY_H
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef POLICY_REAL
#define POLICY_REAL double
#endif
typedef POLICY_REAL policy_real;
/* name(x); in a float build the float function namef(x) */
#define POLICY_F(name, x) \\
    (sizeof(policy_real) == sizeof(float) ? (policy_real)name##f((float)(x)) : (policy_real)name((double)(x)))

#define POLICY_JOINTS {joints}
#define POLICY_OBSERVATIONS {observations}
#define POLICY_ACTIONS {actions}
#define POLICY_STEP_DT {dt!r}

/* The statuses of policy_update; policy_step returns only the first two. */
enum {{
    POLICY_OK,
    POLICY_NOT_FINITE,
    POLICY_HELD,    /* a bad reading was replaced by the last good one */
    POLICY_LATE,    /* control steps were missed */
    POLICY_FALLEN,  /* the robot has fallen: safe stop */
    POLICY_STOPPED, /* bad readings or missed steps for too long: safe stop */
    POLICY_STARTING /* start-up: rest, then lift */
}};

typedef struct {{
{readings}
}} policy_readings;

typedef struct {{
    float position[POLICY_JOINTS]; /* rad */
    float velocity[POLICY_JOINTS]; /* rad/s */
    float effort[POLICY_JOINTS];   /* N m */
}} policy_targets;

typedef struct {{
    int steps;
    float zero[POLICY_JOINTS]; /* of rolling joints: the reading at the reset, minus the default */
    float action[POLICY_ACTIONS];
    float observation[POLICY_OBSERVATIONS];
{memory}
}} policy_state;

{constants}

static inline float policy_clip(float x, float low, float high) {{ return x < low ? low : x > high ? high : x; }}

/* Whether no float is NaN, inf, or at least 2^64. It tests bits, because -ffast-math removes isfinite(). */
static inline int policy_finite(const void *floats, size_t size) {{
    const unsigned char *bytes = (const unsigned char *)floats;
    uint32_t bits;
    size_t i;
    for (i = 0; i + sizeof bits <= size; i += sizeof bits) {{
        memcpy(&bits, bytes + i, sizeof bits);
        if ((bits & 0x7f800000u) >= 0x5f800000u) return 0;
    }}
    return 1;
}}

/* The first sample of an episode fills every slot, oldest first. */
static inline void policy_remember(float *history, const float *sample, int width, int length, int first) {{
    size_t k, last = (size_t)length - 1, w = (size_t)width;
    memmove(history, history + w, w * last * sizeof(float));
    for (k = first ? 0 : last; k <= last; k++) memcpy(history + k * w, sample, w * sizeof(float));
}}

/* y = sum B[j] x[-j] - sum A[k] y[-1 - k]; inputs and outputs newest first. */
static inline float policy_filter(
    float *x, float *y, const float *B, int inputs, const float *A, int outputs, float now) {{
    float sum = 0;
    int k;
    for (k = inputs - 1; k > 0; k--) x[k] = x[k - 1];
    x[0] = now;
    for (k = 0; k < inputs; k++) sum += B[k] * x[k];
    for (k = 0; k < outputs; k++) sum -= A[k] * y[k];
    for (k = outputs - 1; k > 0; k--) y[k] = y[k - 1];
    if (outputs) y[0] = sum;
    return sum;
}}

/* Turns the point p about a line, an axis and a point on it, or moves p along the axis. */
static inline void policy_move(policy_real p[3], const policy_real line[6], policy_real by, int slides) {{
    policy_real c = POLICY_F(cos, by), n = POLICY_F(sin, by), a[3], along = 0;
    int i;
    for (i = 0; i < 3; i++) a[i] = p[i] - line[3 + i], along += a[i] * line[i];
    for (i = 0; i < 3; i++) {{
        int j = (i + 1) % 3, k = (i + 2) % 3;
        policy_real turned = line[3 + i] + along * line[i] + (a[i] - along * line[i]) * c;
        p[i] = slides ? p[i] + line[i] * by : turned + (line[j] * a[k] - line[k] * a[j]) * n;
    }}
}}

/* The unit vector of gravity in the axes of a link with orientation (w, x, y, z); zeros, which policy_update treats as
 * a bad reading, if the length of the quaternion is not between 0.5 and 1.5. */
static inline void policy_projected_gravity(const float quat[4], float out[3]) {{
    float w = quat[0], x = quat[1], y = quat[2], z = quat[3], length = sqrtf(w * w + x * x + y * y + z * z);
    memset(out, 0, 3 * sizeof(float));
    if (!policy_finite(quat, 4 * sizeof(float)) || length < 0.5f || length > 1.5f) return;
    w /= length, x /= length, y /= length, z /= length;
    out[0] = 2 * (w * y - x * z);
    out[1] = -2 * (w * x + y * z);
    out[2] = 2 * (x * x + y * y) - 1;
}}

static inline void policy_reset(policy_state *s) {{ memset(s, 0, sizeof *s); }}

static inline void policy_observe(policy_state *s, const policy_readings *readings) {{
    int i, first = s->steps == 0;
    float v[POLICY_OBSERVATIONS], *next;
    policy_readings counted = *readings;
    const policy_readings *r = &counted;
{zero}
    for (i = 0; i < POLICY_JOINTS; i++) counted.joint_pos[i] -= s->zero[i];
{observe}
}}

/* The mean action of an observation. */
static inline void policy_network(policy_state *s) {{
    policy_real a[{widest}], b[{widest}];
    int i, j;
    for (i = 0; i < POLICY_OBSERVATIONS; i++) {normalize}
{layers}
{clip}}}

/* The targets for newer joint positions: only relative targets differ from those of policy_step. */
static inline int policy_apply(const policy_state *s, const float joint_pos[POLICY_JOINTS], policy_targets *out) {{
    int i;
    if (!policy_finite(joint_pos, POLICY_JOINTS * sizeof(float))) return POLICY_NOT_FINITE;
    memset(out, 0, sizeof *out);
    for (i = 0; i < POLICY_JOINTS; i++) out->position[i] = policy_default_joint_pos[i];
{apply}
{limits}
    for (i = 0; i < POLICY_JOINTS; i++)
        out->velocity[i] = policy_clip(out->velocity[i], -policy_velocity_limit[i], policy_velocity_limit[i]);
    return POLICY_OK;
}}

/* The targets for s->action; advances the moving averages of the actions. */
static inline int policy_act(policy_state *s, const float joint_pos[POLICY_JOINTS], policy_targets *out) {{
    int first = s->steps == 0;
    (void)first;
{processed}
    s->steps++;
    return policy_apply(s, joint_pos, out);
}}

static inline int policy_step(policy_state *s, const policy_readings *r, policy_targets *out) {{
    if (!policy_finite(r, sizeof *r)) return POLICY_NOT_FINITE;
    policy_observe(s, r);
    policy_network(s);
    return policy_act(s, r->joint_pos, out);
}}
{update}
#endif
"""
