"""Write the constants of ``policy_update.h``, which does the same as ``Policy.update`` of ``runner.py``."""

from __future__ import annotations

import math
from collections.abc import Iterator

from wheelleg_exp.jobs.export.bundle.runner import TARGETS, columns
from wheelleg_exp.jobs.export.policy_json import Fall, PolicyJson

_CHECKS = ("bounds", "unit_vector", "command", "encoder")
_NO_BOUND = 1e30  # a float that no reading reaches; ``inf`` is undefined with -ffast-math


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
    table = zip(starts, widths, (_CHECKS.index(rule["check"]) for rule in rules), strict=True)
    yield "static const int policy_rule[POLICY_KINDS][3] = { /* first number, width, check */"
    yield ",\n".join(f"    {{{a}, {b}, {c}}}" for a, b, c in table) + "};"
    yield _array("policy_low", [-_NO_BOUND if v is None else v for rule in rules for v in rule["low"]])
    for key, bounds in (("high", [r["high"] for r in rules]), ("max_jump", [r["max_jump"] for r in rules])):
        yield _array(f"policy_{key}", [_NO_BOUND if v is None else v for values in bounds for v in values])
    for key, values in (("still", [r["still"] for r in rules]), ("slow", [r["slow"] for r in rules])):
        yield _array(f"policy_{key}", [_NO_BOUND if v is None else v for v in values])
    yield _array("policy_norm", [bound for rule in rules for bound in rule.get("norm", (0.0, _NO_BOUND))])
    yield _array("policy_upright", fall["upright"])
    yield _array("policy_safe_position", stop["position"])
    for side, name in enumerate(("low", "high")):
        ends = [(pair[side], (2 * side - 1) * _NO_BOUND) for pair in spec["joint_pos_limits"]]
        yield _array(f"policy_position_{name}", [missing if end is None else end for end, missing in ends])
    yield _array("policy_effort_limit", [_NO_BOUND if limit is None else limit for limit in spec["effort_limit"]])


def _float(value: float) -> str:
    return f"{float(value)!r}f"


def _array(name: str, values: list[float]) -> str:
    return f"static const float {name}[{len(values)}] = {{{', '.join(map(_float, values))}}};"


def _string(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("?", "\\?").replace("\n", "\\n") + '"'
