"""What ``policy.onnx`` says of itself: lists under mjlab's names, and all of ``policy.json``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import onnx

from wheelleg_exp.files import dump_json


def with_metadata(model: bytes, spec: Mapping[str, Any]) -> bytes:
    """Return an ONNX model that carries a bundle's specification.

    Lists are words with commas between, as in mjlab's exports; ``action_scale`` and ``action_offset`` are there where
    every action has them, in the order of ``action_joint_names``.

    Args:
        model: the model.
        spec: ``policy.json``.
    """
    loaded = onnx.load_from_string(model)
    terms = [term for group in spec["observations"] for term in group["terms"]]
    about = {
        "joint_names": _words(spec["joint_names"]),
        "joint_stiffness": _words(spec["stiffness"]),
        "joint_damping": _words(spec["damping"]),
        "default_joint_pos": _words(spec["default_joint_pos"]),
        "command_names": _words(spec["commands"]),
        "observation_names": _words(term["name"] for term in terms),
        "action_joint_names": _words(name for action in spec["actions"] for name in action["joint_names"]),
        "step_dt": str(spec["step_dt"]),
        "decimation": str(spec["decimation"]),
        "policy.json": dump_json(spec),
    }
    for key in ("scale", "offset"):
        if all(key in action for action in spec["actions"]):
            about[f"action_{key}"] = _words(value for action in spec["actions"] for value in action[key])
    for key, value in about.items():
        entry = loaded.metadata_props.add()
        entry.key, entry.value = key, value
    return loaded.SerializeToString()


def _words(values: Iterable[Any]) -> str:
    return ",".join("" if value is None else str(value) for value in values)
