"""Imported policies equal the runners of their authors, and a fault of the import is noticed."""

from __future__ import annotations

import importlib.util
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper, numpy_helper

from tests.isaaclab_import.runs import ROBOT
from wheelleg_exp.isaaclab_import.make_project import import_run

SPEC = importlib.util.spec_from_file_location("author_runners", Path(__file__).parents[2] / "docs/author_runners.py")
assert SPEC is not None
assert SPEC.loader is not None
runners: Any = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(runners)

JOINTS = ["l01", "l02", "l03", "r01", "r02", "r03"]
LIMX: dict[str, Any] = {
    "loop_frequency": 200,
    "joint_names": JOINTS,
    "init_state": {"default_joint_angle": dict(zip(JOINTS, [0.9599, -1.885, 0.0] * 2, strict=True))},
    "control": {
        **{"stiffness": 3.0, "damping": 0.3, "wheel_joint_damping": 0.8, "wheel_joint_torque_limit": 1.0},
        **{"action_scale_pos": 0.25, "decimation": 4, "user_torque_limit": 2.0},
    },
    "normalization": {
        "clip_scales": {"clip_observations": 100.0, "clip_actions": 100.0},
        "obs_scales": {"lin_vel": 2.0, "ang_vel": 0.25, "dof_pos": 1.0, "dof_vel": 0.05},
    },
    "size": {"obs_history_length": 3, "jointpos_idxs": [0, 1, 3, 4]},
    "user_cmd_scales": {"lin_vel_x": 1.5, "lin_vel_y": 1.0, "ang_vel_yaw": 0.5},
}
TRON2 = {
    "init_state": {
        **{"joint_names": JOINTS, "sensor_joint_names": JOINTS},
        "default_joint_angle": LIMX["init_state"]["default_joint_angle"],
    },
    "control": {
        **{"joint_control_modes": ["position", "position", "velocity"] * 2, "wheel_joint_damping": 0.8},
        **{"leg_joint_stiffness": 3.0, "leg_joint_damping": 0.3, "leg_joint_torque_limit": 2.0, "decimation": 10},
        **{"wheel_joint_torque_limit": 1.0, "action_scale_pos": 0.25, "action_scale_vel": 1.5},
    },
    "normalization": LIMX["normalization"],
    "size": {"obs_history_length": 3},
    "commands": {"max": {"lin_vel_x": 0.7, "lin_vel_y": 0.0, "ang_vel_yaw": 1.0}},
    "gait": {"enabled": False},
}
SEEN = 3 + 3 + 4 + 6 + 6


def write_network(path: Path, sizes: list[int], *, normalized: bool = False) -> None:
    """Write a perceptron with the operations of LimX's files."""
    draw, nodes, tensors, name = np.random.default_rng(len(str(path.name))), [], [], "x"
    for layer, (rows, columns) in enumerate(pairwise(sizes)):
        for letter, shape in (("w", (rows, columns)), ("b", (columns,))):
            values = (draw.standard_normal(shape) * 0.3).astype(np.float32)
            tensors.append(numpy_helper.from_array(values, f"{letter}{layer}"))
        last = layer == len(sizes) - 2
        nodes.append(helper.make_node("MatMul", [name, f"w{layer}"], [f"m{layer}"]))
        nodes.append(helper.make_node("Add", [f"m{layer}", f"b{layer}"], ["y" if last else f"a{layer}"]))
        if not last:
            nodes.append(helper.make_node("Elu", [f"a{layer}"], [f"e{layer}"]))
        name = f"e{layer}"
    if normalized:
        tensors += [numpy_helper.from_array(np.full(sizes[0], 2.0, np.float32), letter) for letter in ("mean", "scale")]
        nodes[0].input[0] = "scaled"
        nodes[:0] = [
            helper.make_node("Sub", ["x", "mean"], ["centred"]),
            helper.make_node("Div", ["centred", "scale"], ["scaled"]),
        ]
    ends = [
        helper.make_tensor_value_info(end, TensorProto.FLOAT, [size])
        for end, size in (("x", sizes[0]), ("y", sizes[-1]))
    ]
    model = helper.make_model(helper.make_graph(nodes, "g", ends[:1], ends[1:], tensors))
    model.ir_version, model.opset_import[0].version = 8, 17
    onnx.save(model, path)


@pytest.mark.parametrize("kind", ["isaaclab", "isaacgym", "tron2"])
def test_limx_policies_with_an_encoder_equal_their_runner_and_faults_are_noticed(tmp_path: Path, kind: str) -> None:
    source = tmp_path / ("WF_TRON2A" if kind == "tron2" else "WF_TRON1A")
    policy = source / "policy" / kind / "policy.onnx"
    policy.parent.mkdir(parents=True)
    content = {"Tron2Cfg": TRON2} if kind == "tron2" else {"PointfootCfg": LIMX}
    (source / "params.yaml").write_text(yaml.safe_dump(content))
    write_network(policy, [2 + SEEN + 3, 16, 8, 6])
    write_network(policy.with_name("encoder.onnx"), [3 * SEEN, 12, 8, 2])
    made = import_run(source, ROBOT, tmp_path / f"limx_{kind}", policy=policy)

    def worst(*words: str, reverse: bool = False) -> float:
        env, network = runners.load(made.path, *words)
        runner = runners.runner_of(source, policy)
        if not reverse:
            return max(runners.differences(env, network, runner).values())
        turned = lambda seen: network({"policy": seen["policy"].reshape(8, 3, -1).flip(1).flatten(1)})  # noqa: E731
        return max(runners.differences(env, turned, runner).values())

    assert worst() < 1e-4  # the merged network rounds more
    terms, order = "env.observations.policy.terms", "[r01,l01,l02,r02,l03,r03]"
    faults = (f"env.robot.joint_order={order}", f"{terms}.dof_vel.scale=0.1", f"+{terms}.gravity_vec.scale=-1.0")
    for fault in faults if kind == "isaaclab" else faults[:1]:
        assert worst(fault) > 1e-2, fault
    assert worst(reverse=True) > 1e-2
