"""The policy for deployment: TorchScript, ONNX, and a description of what goes in and comes out."""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Mapping
from typing import Any

import torch
from rsl_rl.models import MLPModel

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.rl.torchscript import serialize

FORMAT_VERSION = 1
_OPSET = 18


def torchscript(policy: MLPModel) -> bytes:
    """Return the deterministic policy as TorchScript: observations (B, O) to actions (B, A).

    Equal policies give equal bytes, in whatever process.
    """
    return serialize(policy.as_jit().eval())


def onnx(policy: MLPModel) -> bytes:
    """Return the deterministic policy as one ONNX file that takes any batch size."""
    model = policy.as_onnx(verbose=False).eval()
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            program = torch.onnx.export(
                model,
                # A batch of 2: torch takes a size of 1 for a constant.
                (torch.zeros(2, model.input_size),),
                input_names=model.input_names,
                output_names=model.output_names,
                dynamic_shapes=({0: torch.export.Dim("batch")},),
                opset_version=_OPSET,
                dynamo=True,
                verbose=False,
            )
    finally:
        logger.setLevel(level)
    assert program is not None
    proto = program.model_proto
    _forget_making(proto)
    return proto.SerializeToString(deterministic=True)


def _forget_making(proto: Any) -> None:
    """Drop the notes on how each part came about: they tell places of this disk, and no runtime reads them."""
    graph = proto.graph
    for part in (proto, graph, *graph.node, *graph.initializer, *graph.input, *graph.output, *graph.value_info):
        part.ClearField("metadata_props")
        if part is not proto:
            part.ClearField("doc_string")


def description(env: ManagerBasedRLEnv, agent: Mapping[str, Any], iteration: int) -> str:
    """Return what a deployer must know, as JSON: rates, joints, and each slice of input and output."""
    groups = agent["obs_groups"]["actor"]
    robot = env.scene.robot
    offset, observations = 0, []
    for group in groups:
        for name, part in env.observation_manager.term_slices(group).items():
            observations.append(
                {"group": group, "term": name, "start": offset + part.start, "stop": offset + part.stop}
            )
        offset += sum(shape[-1] for shape in env.observation_manager.group_obs_term_dim[group])
    start, actions = 0, []
    for name, width in zip(env.action_manager.active_terms, env.action_manager.action_term_dim, strict=True):
        term = env.action_manager.get_action_term(name)
        joints = getattr(term, "joint_names", [])
        actions.append({"term": name, "start": start, "stop": start + width, "joints": list(joints)})
        start += width
    content = {
        "format_version": FORMAT_VERSION,
        "iteration": iteration,
        "control_dt_s": env.step_dt,
        "robot_profile": robot.options.profile,
        "joint_order": robot.joint_names,
        "default_joint_pos_rad": dict(zip(robot.joint_names, robot.default_joint_pos.tolist(), strict=True)),
        "observation_width": offset,
        "observations": observations,
        "observation_config": {group: env.cfg["observations"][group] for group in groups},
        "action_width": start,
        "clip_actions": agent.get("clip_actions"),
        "actions": actions,
        "action_config": env.cfg["actions"],
        "actuators": env.cfg["robot"]["actuators"],
    }
    return json.dumps(content, indent=2) + "\n"
