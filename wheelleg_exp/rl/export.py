"""Export a policy for deployment as TorchScript and ONNX, with a description of its inputs and outputs."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from typing import Any

import torch
from rsl_rl.models import MLPModel

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.terms.config_sections import plain_section

FORMAT_VERSION = 1
_OPSET = 18
_SOURCE_PATHS = ".debug_pkl"  # records with source paths


def torchscript(policy: MLPModel) -> bytes:
    """Return the deterministic policy as TorchScript: observations (B, O) to actions (B, A)."""
    archive = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(policy.as_jit().eval()), archive)
    copy = io.BytesIO()
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(copy, "w", zipfile.ZIP_STORED) as target:
        for name in source.namelist():
            if not name.endswith(_SOURCE_PATHS):
                target.writestr(zipfile.ZipInfo(name), source.read(name))
    return copy.getvalue()


def onnx(policy: MLPModel) -> bytes:
    """Return the deterministic policy as one ONNX file that takes any batch size."""
    model = policy.as_onnx(verbose=False).eval()
    names = {"input_names": model.input_names, "output_names": model.output_names}
    names["dynamic_axes"] = {name: {0: "batch"} for name in (*model.input_names, *model.output_names)}
    file: Any = io.BytesIO()
    # Use torch's old tracing ONNX exporter, because `torch.export` takes two seconds and caches data per batch size.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        inputs = model.get_dummy_inputs()
        torch.onnx.export(model, inputs, file, **names, opset_version=_OPSET, dynamo=False, verbose=False)
    return bytes(file.getvalue())


def description(env: ManagerBasedRLEnv, agent: Learning, iteration: int) -> str:
    """Return the description for deployment as JSON: rates, joints, and each slice of input and output."""
    groups = agent.obs_groups[agent.roles[0]]
    robot = env.scene.robot
    offset, observations = 0, []
    for group in groups:
        for name, parts in env.observation_manager.term_parts(group).items():
            for age, part in zip(reversed(range(len(parts))), parts, strict=True):
                steps = {"age_steps": age} if len(parts) > 1 else {}
                place = {"start": offset + part.start, "stop": offset + part.stop}
                observations.append({"group": group, "term": name, **place, **steps})
        offset += sum(shape[-1] for shape in env.observation_manager.group_obs_term_dim[group])
    start, actions = 0, []
    for name, width in zip(env.action_manager.active_terms, env.action_manager.action_term_dim, strict=True):
        joints = getattr(env.action_manager.get_term(name), "joint_names", [])
        actions.append({"term": name, "start": start, "stop": start + width, "joints": list(joints)})
        start += width
    content = {
        "format_version": FORMAT_VERSION,
        "iteration": iteration,
        "control_dt_s": env.step_dt,
        "robot_profile": robot.options.profile,
        "joint_order": robot.joint_names,
        "default_joint_pos_rad": dict(zip(robot.joint_names, robot.layout.default_joint_pos.tolist(), strict=True)),
        "observation_width": offset,
        "observations": observations,
        "observation_config": {group: plain_section(env.options.observations[group]) for group in groups},
        "action_width": start,
        "clip_actions": agent.clip_actions,
        "actions": actions,
        "action_config": env.options.actions,
        "actuators": env.options.robot.actuators,
    }
    return json.dumps(content, indent=2) + "\n"
