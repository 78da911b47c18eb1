"""``policy.h`` of a bundle: the policy as one C99 header, from sensor readings to joint targets.

It is written out of ``policy.json`` and the network's arrays, a few lines for each term: what is fixed stands as a
constant, what is remembered in a struct.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from wheelleg_exp.jobs.export.c_terms import action_lines, action_memory, identifier, number, term_lines, term_memory
from wheelleg_exp.jobs.export.c_terms import in_comment as _plain

_ACTIVATIONS = {
    "elu": "x > 0 ? x : expm1(x)",
    "relu": "x > 0 ? x : 0",
    "leaky_relu": "x > 0 ? x : 0.01 * x",
    "selu": "1.0507009873554805 * (x > 0 ? x : 1.6732632423543772 * expm1(x))",
    "tanh": "tanh(x)",
    "sigmoid": "1 / (1 + exp(-x))",
    "softplus": "(x > 0 ? x : 0) + log1p(exp(-fabs(x)))",
    "swish": "x / (1 + exp(-x))",
    "identity": "x",
}


def c_header(spec: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> str:
    """Return the header.

    Args:
        spec: ``policy.json``.
        arrays: the network's arrays by name, as ``policy.npz`` has them.
    """
    terms = [
        (f"{g}_{t}", term) for g, group in enumerate(spec["observations"]) for t, term in enumerate(group["terms"])
    ]
    actions = [(str(number), term) for number, term in enumerate(spec["actions"])]
    joints, about = len(spec["joint_names"]), spec["run"]
    memory = [line for name, term in terms for line in term_memory(name, term)]
    memory += [line for name, term in actions for line in action_memory(name, term)]
    observe = [line for name, term in terms for line in term_lines(name, term, spec)]
    processed = [line for name, term in actions for line in action_lines(name, term)]
    widths = spec["network"]["widths"]
    return _HEADER.format(
        about=_plain(f"The policy '{about['task']}' of run {about['id']}, iteration {about['iteration']}."),
        joint_names=_listed(f"{i} {name}" for i, name in enumerate(spec["joint_names"])),
        joints=joints,
        observations=spec["observation_width"],
        actions=spec["action_width"],
        dt=float(spec["step_dt"]),
        rolling=_listed(spec["rolling_joints"]) or "none",
        readings="\n".join(
            f"    float {identifier(name)}[{known['width']}]; /* {known['unit']}: {_plain(known['meaning'])} */"
            for name, known in spec["readings"].items()
        ),
        memory="\n".join(f"    {line}" for line in memory),
        constants="\n".join(_constants(spec, arrays)),
        widest=max([spec["observation_width"], *widths]),
        observe=_indented([*observe, *_layout(spec)], 4),
        normalize=_NORMALIZE if spec["network"]["normalized"] else _COPY,
        zero=_indented(_zero(spec), 4),
        limits=_indented(_limits(spec), 4),
        layers=_indented(_layers(spec), 4),
        clip="" if spec["clip_actions"] is None else _CLIP.format(bound=number(spec["clip_actions"])),
        processed=_indented(processed, 4),
        apply=_indented(_applied(spec), 4),
    )


def _listed(words: Iterable[str]) -> str:
    return ", ".join(map(_plain, words))


def _indented(lines: Iterable[str], spaces: int) -> str:
    return "\n".join(f"{' ' * spaces}{line}" for line in lines)


def _array(kind: str, name: str, values: Iterable[str]) -> str:
    words, lines = list(values), []
    for start in range(0, len(words), 10):
        lines.append("    " + ", ".join(words[start : start + 10]))
    return f"static const {kind} {name}[{len(words)}] = {{\n" + ",\n".join(lines) + "};"


def _constants(spec: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Iterable[str]:
    yield _array("float", "policy_default_joint_pos", map(number, spec["default_joint_pos"]))
    yield _array("float", "policy_velocity_limit", map(number, spec["velocity_limit"]))
    for name, array in arrays.items():
        kind = "double" if array.dtype == np.float64 else "float"
        words = (repr(float(v)) if kind == "double" else f"{float(v):.9g}" for v in array.ravel())
        yield _array(kind, f"policy_{name}", (_literal(word, kind) for word in words))


def _literal(word: str, kind: str) -> str:
    """Return a C literal: ``1f`` is none."""
    point = "" if any(mark in word for mark in ".en") else ".0"
    return word + point + ("f" if kind == "float" else "")


def _layout(spec: Mapping[str, Any]) -> Iterable[str]:
    """Copy histories into the observation, as their groups stand in it."""
    yield "next = s->observation;"
    for g, group in enumerate(spec["observations"]):
        lengths = [max(1, term["history_length"]) for term in group["terms"]]
        by_time = group["history_order"] == "time"
        for step in range(lengths[0] if by_time else 1):
            for t, term in enumerate(group["terms"]):
                count = term["width"] * (1 if by_time else lengths[t])
                start = step * term["width"] if by_time else 0
                yield f"memcpy(next, s->history_{g}_{t} + {start}, {count} * sizeof(float)); next += {count};"


def _layers(spec: Mapping[str, Any]) -> Iterable[str]:
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


def _zero(spec: Mapping[str, Any]) -> Iterable[str]:
    for i in map(spec["joint_names"].index, spec["rolling_joints"]):
        yield f"if (first) s->zero[{i}] = counted.joint_pos[{i}] - policy_default_joint_pos[{i}];"


def _limits(spec: Mapping[str, Any]) -> Iterable[str]:
    for i, (low, high) in enumerate(spec["joint_pos_limits"]):
        position = f"out->position[{i}]"
        yield f"{position} = policy_clip({position} + s->zero[{i}], {number(low, '-FLT_MAX')}, {number(high)});"


def _applied(spec: Mapping[str, Any]) -> Iterable[str]:
    for place, term in enumerate(spec["actions"]):
        for index, joint in enumerate(term["joint_ids"]):
            relative = f"joint_pos[{joint}] - s->zero[{joint}] + " if term["function"] == "relative" else ""
            yield f"out->{term['drives']}[{joint}] = {relative}s->processed_{place}[{index}];"


_NORMALIZE = "a[i] = (s->observation[i] - (policy_real)policy_mean[i]) / (policy_real)policy_deviation[i];"
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
 * C99, needs the C library's math. -DPOLICY_REAL=float runs the network in single precision.
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

#define POLICY_JOINTS {joints}
#define POLICY_OBSERVATIONS {observations}
#define POLICY_ACTIONS {actions}
#define POLICY_STEP_DT {dt!r}

enum {{ POLICY_OK, POLICY_NOT_FINITE }};

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

/* The unit vector of gravity in the axes of a link with orientation (w, x, y, z). */
static inline void policy_projected_gravity(const float quat[4], float out[3]) {{
    float w = quat[0], x = quat[1], y = quat[2], z = quat[3];
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
#endif
"""
