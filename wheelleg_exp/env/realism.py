"""Add the errors of a real robot to a task, or remove them: noise and delays of sensors, delays of actions, and events.

The section ``env.realism`` names functions of observations instead of terms, so that one variant fits every task.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping
from typing import Any

from wheelleg_exp.terms.config_sections import ActionRealism, Realism, SensorRealism, read_section


def with_realism(env_cfg: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config section ``env`` with the errors of its section ``realism`` in its terms."""
    realism = read_section(Realism, env_cfg.get("realism") or {}, "env.realism")
    cfg = dict(env_cfg)
    if realism == Realism():
        return cfg
    # The variant's events change the values that the task's events set, so they run last.
    events = {name: cfg["events"][name] for name in realism.events if cfg["events"].get(name) is not None}
    moved = {*events, *realism.replaces}
    cfg["events"] = {name: node for name, node in cfg["events"].items() if name not in moved} | events
    cfg = with_sensor_errors(cfg, realism.sensors, realism.groups)
    return with_action_delay(cfg, realism.actions)


def without_errors(env_cfg: Mapping[str, Any]) -> tuple[int, int]:
    """Return how many of the first robots have exact sensors and bodies, and how many have actions without delay."""
    realism = read_section(Realism, env_cfg.get("realism") or {}, "env.realism")
    count = env_cfg["num_envs"]
    return round(realism.exact_share * count), round(realism.actions.prompt_share * count)


def without_realism(env_cfg: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config section ``env`` of the same task with ``realism=none``."""
    cfg, realism = {**env_cfg}, env_cfg.get("realism") or {}
    for section in ("events", "curriculum"):
        cfg[section] = {n: node for n, node in cfg[section].items() if n not in realism.get(section, [])}
    cfg.pop("realism", None)
    return cfg


def without_pushes(env_cfg: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config section ``env`` without events during an episode, such as pushes and kicks."""
    events = {name: node for name, node in (env_cfg.get("events") or {}).items() if isinstance(node, Mapping)}
    return {**env_cfg, "events": {n: e for n, e in events.items() if e.get("mode") not in ("interval", "step")}}


def without_disturbances(env_cfg: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config section ``env`` without pushes, random forces, noise, and curricula of removed events."""
    cfg = copy.deepcopy(without_pushes(env_cfg))
    cfg["events"] = {n: e for n, e in cfg["events"].items() if not {"force_range", "torque_range"} & e.keys()}
    lost, curricula = (env_cfg.get("events") or {}).keys() - cfg["events"].keys(), cfg.get("curriculum") or {}
    of_lost = re.compile(rf"events\.({'|'.join(map(re.escape, lost)) or '(?!)'})\b")
    kept = {n: c for n, c in curricula.items() if c and not of_lost.match(str(c.get("address")))}
    nodes = [*((cfg.get("realism") or {}).get("sensors") or {}).values()]
    for group in filter(None, (cfg.get("observations") or {}).values()):
        group["enable_corruption"] = False
        nodes += group["terms"].values()
    for node in filter(None, nodes):
        node["noise"] = None
    return {**cfg, "curriculum": kept}


def with_action_delay(env_cfg: Mapping[str, Any], errors: ActionRealism) -> dict[str, Any]:
    """Return the config section ``env`` with a delay of all actions."""
    dt = env_cfg["sim"]["dt"]
    return {**env_cfg, "actions": {name: _delayed(node, errors, dt) for name, node in env_cfg["actions"].items()}}


def with_sensor_errors(
    env_cfg: Mapping[str, Any], sensors: Mapping[str, SensorRealism], groups: list[str]
) -> dict[str, Any]:
    """Return the config section ``env`` with sensor errors, by function, in the terms of the observation ``groups``."""
    cfg = {**env_cfg, "observations": copy.deepcopy(dict(env_cfg["observations"]))}
    for group in (cfg["observations"][name] for name in groups if cfg["observations"].get(name) is not None):
        is_noisy, group["enable_corruption"] = bool(group.get("enable_corruption")), True
        for name, node in group["terms"].items():
            errors = None if node is None else sensors.get(str(node["_target_"]).rpartition(".")[2])
            if errors is not None:
                group["terms"][name] = node = _delayed(node, errors, cfg["sim"]["dt"])
            if node is not None and (not is_noisy or (errors is not None and errors.noise is not None)):
                # A group without noise in the task must get no noise but that of the sensor.
                node["noise"] = None if errors is None else errors.noise
    return cfg


def _delayed(node: Any, errors: SensorRealism | ActionRealism, dt: float) -> Any:
    low, high = (round(delay / dt) for delay in errors.delay_s)
    jitter = round(errors.jitter_s / dt)
    return node if node is None or high + jitter == 0 else {**node, "delay": [low, high], "delay_jitter": jitter}
