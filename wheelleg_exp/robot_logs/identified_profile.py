"""Write a robot profile with identified motor parameters, for ``robot=<name>``."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from wheelleg_exp.robot_logs.motor_identification import Identified, Parameter

_KEYS = ("armature", "friction", "viscous_friction")
_ROUNDED = 0.05  # A delay this close to a whole number of physics steps is rounded.
_UNITS = ("kg·m²", "N·m", "N·m·s/rad")


def profile_text(found: Identified, base: str, name: str, log: str, groups: Mapping[str, Sequence[str]]) -> str:
    """Return the YAML of a profile that inherits from the robot config ``base``.

    ``groups`` contains the joints of each actuator group. Each value is followed by its 95 % confidence interval.
    """
    values = {(p.joint, p.name): p for p in found.parameters}
    printable = re.sub(r"[^\w ./-]", "?", log)
    lines = ["# @package env.robot", f"# Like `{base}`, with motors identified from {printable}."]
    lines += ["# The comments contain 95 % confidence intervals."]
    lines += [f"# The values are those of continuous joints whose drives compute torques at {found.drive_rate:.4g} Hz."]
    lines += ["# A physics step of training adds damping to them: the shorter the step (sim=fine), the less."]
    lines += ["defaults:", f"  - {base}", "  - _self_"]
    lines += [f"profile: {name}", "actuators:"]
    for group, joints in groups.items():
        lines.append(f"  {group}:")
        for key, unit in zip(_KEYS, _UNITS, strict=True):
            lines += _mapping(key, unit, [(values[joint, key], 1.0) for joint in joints])
        for key, unit in (("stiffness", "N·m/rad"), ("damping", "N·m·s/rad")):
            lines += _mapping(key, unit, [(values[joint, "gain"], found.drives[key][joint]) for joint in joints])
        delays = [values[joint, "delay"] for joint in joints]
        steps = [p.value / found.physics_dt for p in delays]
        text = ", ".join(f"{p.joint} {1e3 * p.value:.3g} ms ({1e3 * p.low:.3g} to {1e3 * p.high:.3g})" for p in delays)
        bounds = [math.floor(min(steps) + _ROUNDED), math.ceil(max(steps) - _ROUNDED)]
        low, high = min(bounds), max(bounds)
        delay = f"min_delay: {low}\n    max_delay: {high}" if group in found.delayed else f"delay: [{low}, {high}]"
        lines.append(f"    {delay}   # physics steps; {text}")
        for p in (values[joint, "effort_scale"] for joint in joints if (joint, "effort_scale") in values):
            interval = f"({p.low:.4g} to {p.high:.4g})"
            lines.append(f"    # The logged effort of {p.joint} is {p.value:.4g} times its torque {interval}.")
    return "\n".join(lines) + "\n"


def _mapping(key: str, unit: str, values: Sequence[tuple[Parameter, float]]) -> list[str]:
    lines = [f"    {key}:   # {unit}"]
    for p, factor in values:
        interval = f"{factor * p.low:.4g} to {factor * p.high:.4g}"
        lines.append(f"      '{re.escape(p.joint)}': {factor * p.value:.5g}   # {interval}")
    return lines
