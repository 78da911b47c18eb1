"""Convert the state of an environment in a checkpoint of format version 2 to the present layout."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

_TAG = "__kind__"


def from_format_2(env: Mapping[str, object]) -> dict[str, object]:
    """Return the state of an environment in the present layout; ``restore`` ignores the values it does not need.

    Format version 2 tagged containers, named private attributes without their underscore, and stored the values of
    some parts next to those of their owner. It also contained tensors that are constant.
    """
    found: dict[str, Any] = _plain(env)
    found["attributes"] = {"attributes": {n: {"now": value} for n, value in found.get("attributes", {}).items()}}
    scene, managers = found["scene"], found["managers"]
    robot: dict[str, Any] = _private(scene["robot"])
    robot["_wrench_bodies"] = tuple(robot["wrench_bodies"])
    robot["targets"] = {name: robot[f"joint_{name}_target"] for name in ("pos", "vel", "effort")}
    # ``body_vel_before`` is missing if no term has read accelerations.
    robot["data"] = robot | robot["settings"] | {"_vel_before": robot.get("body_vel_before")}
    scene["robot"] = robot
    for name, sensor in scene["sensors"].items():
        output = {key.removeprefix("output."): value for key, value in sensor.items() if key.startswith("output.")}
        times = {key: value for key, value in sensor.items() if key.endswith("_time")}
        data = sensor | {"output": output, "times": times}
        if "history" in sensor:
            data["forces"] = list(sensor["history"].unbind(dim=1))
        own = {"_bias_b": sensor.get("bias"), "_noise_b": sensor.get("noise")} if "bias" in sensor else {}
        scene["sensors"][name] = _private(sensor) | own | {"data": data, "_data": data}
    managers |= {name: _private(manager) for name, manager in managers.items()}
    rewards, curriculum = managers.get("rewards", {}), managers.get("curriculum", {})
    rewards["_sums"], curriculum["_state"] = rewards.get("episode_sums"), curriculum.get("last")
    for terms in managers["observations"]["groups"].values():
        for term in terms.values():
            term["_modifiers"], term["_noise"] = dict(enumerate(term["modifiers"])), _private(term["noise"])
    return found


def present_delay(values: Mapping[str, Any]) -> dict[str, object]:
    """Return the state of a delay; at first it had no jitter and no share, later one share for all environments."""
    share = torch.ones(values["lag"].shape) * values.get("share", 1.0)
    return _private({"last_lag": values["lag"], **values, "share": share})


def _private(values: Mapping[str, object]) -> dict[str, object]:
    """Return values under their names with and without a leading underscore."""
    return {**{f"_{name}": value for name, value in values.items()}, **values}


def _plain(value: object) -> Any:
    """Return a value in which containers, arrays, and generators have no tag, and delays have the present layout."""
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    found = {key: _plain(item) for key, item in value.items()}
    if kind := found.get(_TAG):
        items = found["items"] if "items" in found else found["data"]
        if kind == "dict":
            return dict(zip(found["keys"], items, strict=True))
        return items.item() if kind == "scalar" else tuple(items) if kind == "tuple" else items
    return present_delay(found) if {"lag", "samples", "is_first"} <= found.keys() else found
