"""Test exported policies: one file per format, actions equal to the policy's, and a correct description."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import rsl_rl
import torch
from patience import PATIENCE_S
from tensordict import TensorDict

from wheelleg_exp.rl import export
from wheelleg_exp.rl.options import read_agent
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.verify.policy_differences import exported_part

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def trainer(make_trainer):
    """Return a policy whose observation normalizer has processed random observations."""
    made = make_trainer("agent.actor.obs_normalization=true")
    seen = torch.randn(64, 135, generator=torch.Generator().manual_seed(3)) * 3.0 + 1.0
    made.algorithm.actor.update_normalization(TensorDict({"policy": seen, "critic": torch.zeros(64, 180)}, [64]))
    return made


@pytest.fixture(scope="module")
def policy(trainer):
    return trainer.algorithm.get_policy().eval()


@pytest.fixture(scope="module")
def model(policy) -> bytes:
    return export.onnx(policy)


@pytest.fixture(scope="module")
def described(trainer, tiny_config):
    return json.loads(export.description(trainer.env.env, read_agent(tiny_config()["agent"]), 41))


def by_hand(policy, observations: torch.Tensor) -> np.ndarray:
    """The mean action in float64: (x - mean) / (std + eps), then linear layers with ELU between."""
    normalizer = policy.obs_normalizer
    x = observations.double().numpy()
    x = (x - normalizer._mean.double().numpy()) / (normalizer._std.double().numpy() + normalizer.eps)
    layers = [layer for layer in policy.mlp if isinstance(layer, torch.nn.Linear)]
    for k, layer in enumerate(layers):
        x = x @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()
        if k + 1 < len(layers):
            x = np.where(x > 0, x, np.expm1(np.minimum(x, 0)))
    return x


def test_onnx_passes_the_checker_and_is_one_file(model):
    loaded = onnx.load_from_string(model)
    onnx.checker.check_model(loaded, full_check=True)
    assert all(t.data_location == onnx.TensorProto.DEFAULT for t in loaded.graph.initializer)


@pytest.mark.parametrize("batch", [1, 2, 7])
def test_torch_torchscript_and_onnx_give_the_same_actions(policy, model, batch):
    observations = torch.randn(batch, 135, generator=torch.Generator().manual_seed(batch))
    session = onnxruntime.InferenceSession(model)
    (name,) = [entry.name for entry in session.get_inputs()]
    (from_onnx,) = session.run(None, {name: observations.numpy()})
    with torch.no_grad():
        from_torch = policy(TensorDict({"policy": observations}, [batch]))
        from_script = torch.jit.load(io.BytesIO(export.torchscript(policy)))(observations)
    expected = by_hand(policy, observations)
    assert from_onnx.shape == (batch, 6)
    for found in (from_torch.numpy(), from_script.numpy(), from_onnx):
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_an_export_draws_no_random_numbers_and_leaves_the_policy_unchanged(policy):
    stream, before = torch.get_rng_state(), {name: value.clone() for name, value in policy.state_dict().items()}
    export.torchscript(policy)
    assert torch.equal(torch.get_rng_state(), stream)
    assert all(torch.equal(before[name], value) for name, value in policy.state_dict().items())


_EXPORT = """
import io, json, sys
from pathlib import Path
import torch
from tensordict import TensorDict
from rsl_rl.models import MLPModel
from wheelleg_exp.rl import export

def policy(*hidden):
    torch.manual_seed(0)
    observations = TensorDict({"policy": torch.zeros(2, 9)}, batch_size=[2])
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0}
    return MLPModel(observations, {"actor": ["policy"]}, "actor", 3, hidden, "elu", True, gaussian)

for hidden, folder in zip(json.loads(sys.argv[1]), map(Path, sys.argv[2:]), strict=True):
    made = policy(*hidden).eval()
    script, graph = export.torchscript(made), export.onnx(made)
    (folder / "policy.pt").write_bytes(script)
    (folder / "policy.onnx").write_bytes(graph)
x = torch.randn(7, 9, generator=torch.Generator().manual_seed(1))
loaded = torch.jit.load(io.BytesIO(script))
assert torch.equal(loaded(x), made.as_jit()(x)) and not loaded.training
assert set(loaded.state_dict()) == set(made.as_jit().state_dict())
loaded.reset()
"""


def exported_elsewhere(folder: Path, hash_seed: int, *hidden: list[int]) -> list[RunDirectory]:
    """Return run directories with exported policies; a child process exports the policies in turn."""
    runs = [RunDirectory(folder / str(number)) for number in range(len(hidden))]
    for run in runs:
        run.exported.mkdir(parents=True)
    command = [sys.executable, "-W", "ignore", "-c", _EXPORT, json.dumps(hidden), *(run.exported for run in runs)]
    subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": str(hash_seed)}, check=True, timeout=PATIENCE_S)
    return runs


def test_what_is_exported_depends_neither_on_the_process_nor_on_what_it_exported_before(tmp_path):
    (first,) = exported_elsewhere(tmp_path / "first", 1, [8, 8, 6])
    _, wider, other = exported_elsewhere(tmp_path / "other", 3, [4], [8, 8, 8], [8, 8, 6])
    assert (first.exported / "policy.onnx").read_bytes() == (other.exported / "policy.onnx").read_bytes()
    assert exported_part(first, other).state == "equal"
    assert exported_part(first, wider).state == "different"


def test_the_exports_name_no_place_of_this_disk(policy, model):
    places = [str(Path(rsl_rl.__file__).parents[1]).encode(), str(Path(export.__file__).parents[2]).encode()]
    with zipfile.ZipFile(io.BytesIO(export.torchscript(policy))) as archive:
        contents = [archive.read(name) for name in archive.namelist()]
    assert not [place for place in places for content in (*contents, model) if place in content]


def test_the_slices_of_the_observation_hold_what_they_name(trainer, described):
    env = trainer.env.env
    env.reset()
    action = torch.linspace(-0.3, 0.3, 6).repeat(16, 1)
    observations, *_ = env.step(action)
    data = env.scene.robot.data
    expected = {
        "base_ang_vel": data.root_ang_vel_b * 0.25,
        "projected_gravity": data.projected_gravity_b,
        "velocity_commands": torch.zeros(16, 3),
        "joint_pos_rel": (data.joint_pos - data.default_joint_pos)[:, :4],
        "joint_vel_rel": data.joint_vel * 0.05,
        "last_action": action,
        "travel_error": env.command_manager.get_term("base_velocity").travel_error * 20,
    }
    slices = {entry["term"]: (entry["group"], entry["start"], entry["stop"]) for entry in described["observations"]}
    assert list(slices) == list(expected)
    assert described["observation_width"] == max(stop for *_, stop in slices.values()) == 135
    for name, (group, start, stop) in slices.items():
        width = expected[name].shape[1]
        assert (group, stop - start) == ("policy", 5 * width)
        torch.testing.assert_close(observations[group][:, stop - width : stop], expected[name], msg=name)


def test_the_slices_of_the_action_move_the_joints_that_they_name(trainer, described):
    env = trainer.env.env
    columns = [joint for entry in described["actions"] for joint in entry["joints"]]
    slices = [(entry["term"], entry["start"], entry["stop"]) for entry in described["actions"]]
    assert slices == [("leg_pos", 0, 4), ("wheel_vel", 4, 6)]
    assert described["action_width"] == len(columns) == 6
    data, names = env.scene.robot.data, env.scene.robot.joint_names
    for column, joint in enumerate(columns):
        targets = []
        for value in (0.0, 1.0):
            action = torch.zeros(16, 6)
            action[:, column] = value
            env.action_manager.process_action(action)
            env.action_manager.apply_action()
            targets.append(torch.stack([data.joint_pos_target[0], data.joint_vel_target[0]]).clone())
        moved = (targets[0] != targets[1]).any(dim=0).nonzero().squeeze(1).tolist()
        assert [names[i] for i in moved] == [joint]


def test_the_description_holds_the_rest_that_a_deployer_needs(trainer, described):
    assert (described["iteration"], described["control_dt_s"]) == (41, pytest.approx(1 / 60))
    assert described["robot_profile"] == "article"
    assert described["joint_order"] == ["l01", "r01", "l02", "r02", "l03", "r03"]
    expected = {"l01": 0.9599, "r01": 0.9599, "l02": -1.885, "r02": -1.885, "l03": 0.0, "r03": 0.0}
    assert described["default_joint_pos_rad"] == pytest.approx(expected, abs=1e-6)
    assert described["actuators"]["legs"]["stiffness"] == 3.0
    assert described["observation_config"]["policy"]["history_length"] == 5
    assert described["action_config"]["wheel_vel"]["scale"] == 5.0


def test_the_description_lists_several_groups_in_order_and_clipped_actions(trainer, tiny_config):
    agent = tiny_config("agent.obs_groups.actor=[critic,policy]", "+agent.clip_actions=0.7")["agent"]
    found = json.loads(export.description(trainer.env.env, read_agent(agent), 0))
    assert (found["observation_width"], found["clip_actions"]) == (315, 0.7)
    assert found["observations"][0] == {"group": "critic", "term": "base_ang_vel", "start": 0, "stop": 15}
    assert found["observations"][-1] == {"group": "policy", "term": "travel_error", "start": 305, "stop": 315}
