"""Observation and action terms as lines of C: ``r`` are the readings, ``s`` is what is remembered, ``v`` a sample."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

Spec = Mapping[str, Any]
_LEAST, _MOST = np.finfo(np.float32).min, np.finfo(np.float32).max


def term_memory(name: str, term: Spec) -> Iterator[str]:
    """Yield what an observation term remembers."""
    yield f"float history_{name}[{term['width'] * max(1, term['history_length'])}];"
    if term["function"] == "travel_error":
        yield f"float travelled_{name}[2], commanded_{name}[2];"
    for number_of, modifier in enumerate(term["modifiers"]):
        if modifier["kind"] == "integrator":
            yield f"float total_{name}_{number_of}[{term['width']}], before_{name}_{number_of}[{term['width']}];"
        if modifier["kind"] == "filter":
            sizes = (term["width"] * len(modifier["B"]), max(1, term["width"] * len(modifier["A"])))
            yield f"float in_{name}_{number_of}[{sizes[0]}], out_{name}_{number_of}[{sizes[1]}];"


def term_lines(name: str, term: Spec, spec: Spec) -> Iterator[str]:
    """Yield how an observation term is sampled into its history."""
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


def action_memory(name: str, term: Spec) -> Iterator[str]:
    """Yield what an action term remembers."""
    yield f"float processed_{name}[{len(term['joint_ids'])}];"


def action_lines(name: str, term: Spec) -> Iterator[str]:
    """Yield what an action term makes of its part of the action, ``s->processed_<name>``."""
    for i, joint in enumerate(term["joint_ids"]):
        out = f"s->processed_{name}[{i}]"
        if "alpha" in term:  # the average begins where the joints are
            yield "{"
            yield f"    float last = first ? joint_pos[{joint}] - s->zero[{joint}] : {out};"
        yield from (f"    {line}" if "alpha" in term else line for line in _processed(out, term, i))
        if "alpha" in term:
            low, high = number(term["low"][i], "-FLT_MAX"), number(term["high"][i])
            yield f"    {out} = policy_clip(last + {number(term['alpha'][i])} * ({out} - last), {low}, {high});"
            yield "}"


def number(value: float | None, missing: str = "FLT_MAX") -> str:
    """Return a float of C; null is ``missing``, and inf the largest float: -ffast-math has no inf."""
    return missing if value is None else f"{float(np.clip(np.float32(value), _LEAST, _MOST))!r}f"


def _processed(out: str, term: Spec, i: int) -> Iterator[str]:
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
        low, high = np.float32(term["low"][i]), np.float32(term["high"][i])
        middle, half = number(float((low + high) / 2)), number(float((high - low) / 2))
        yield f"{out} = {middle} + policy_clip({out}, -1.0f, 1.0f) * {half};"


def _value(name: str, term: Spec, dt: float) -> Iterator[str]:
    kind, columns = term["function"], term.get("columns")
    time = f"(float)s->steps * {number(dt)}"
    if kind == "last_action":
        yield from (f"v[{i}] = s->action[{column}];" for i, column in enumerate(columns or ()))
    elif kind == "time":
        yield f"v[0] = {time};"
    elif kind == "remaining_time":
        yield f"v[0] = {number(term['episode_length_s'])} - {time};"
    elif kind == "gait_phase":
        yield from _gait(term, dt)
    elif kind == "travel_error":
        yield from _travelled(name, term, dt)
    else:
        yield from _read(term)


def _read(term: Spec) -> Iterator[str]:
    source, columns = f"r->{identifier(term['reading'])}", term.get("columns")
    if term["function"] == "roll_pitch":
        yield f"v[0] = (float)atan2(-{source}[1], -{source}[2]);"
        yield f"v[1] = (float)asin(policy_clip({source}[0], -1.0f, 1.0f));"
        return
    count = len(columns) if columns is not None else term["width"]
    for i in range(count):
        x = f"{source}[{i if columns is None else columns[i]}]"
        if term["function"] == "sin_cos":
            yield f"v[{i}] = (float)sin({x}); v[{i + count}] = (float)cos({x});"
        elif term["function"] == "minus_default":
            yield f"v[{i}] = {x} - ({number(term['subtract'][i])});"
        elif term["function"] == "within_limits":
            yield f"v[{i}] = 2.0f * ({x} - ({number(term['middle'][i])})) / {number(term['range'][i])};"
        else:
            yield f"v[{i}] = {x};"


def _gait(term: Spec, dt: float) -> Iterator[str]:
    offsets = term["offsets"]
    for i, offset in enumerate(offsets):
        cycles = f"(float)s->steps * {number(dt / term['period'])} + ({number(offset)})"
        angle = f"{number(2 * np.pi)} * (float)fmod({cycles}, 1.0)"
        yield f"v[{i}] = (float)sin({angle}); v[{i + len(offsets)}] = (float)cos({angle});"


def _travelled(name: str, term: Spec, dt: float) -> Iterator[str]:
    pairs = zip(term["columns"], term["signs"], strict=True)
    wheels = " ".join(f"{'+' if sign > 0 else '-'} r->joint_vel[{column}]" for column, sign in pairs)
    rates = (f"({wheels}) / {len(term['columns'])}.0f * {number(term['wheel_radius'])}", "r->base_ang_vel[2]")
    most, command = (term["max_travel_error"], term["max_heading_error"]), f"r->{identifier(term['command'])}"
    for i, (rate, bound, column) in enumerate(zip(rates, most, (0, 2), strict=True)):
        total, before = f"s->travelled_{name}[{i}]", f"s->commanded_{name}[{i}]"
        missed = f"({rate} - {before}) * {number(dt)}"
        yield f"if (!first) {total} = policy_clip({total} + {missed}, -{number(bound)}, {number(bound)});"
        yield f"{before} = {command}[{column}]; v[{i}] = {total};"


def _modified(name: str, modifier: Spec) -> str:
    """Return how a modifier changes ``v[i]``."""
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
    """Return a name that C takes."""
    return re.sub(r"\W", "_", name)


def in_comment(text: str) -> str:
    """Return text that cannot end a C comment: export compiles the header, and names come from foreign files."""
    return text.replace("*", "_")
