import io
import shutil

import numpy as np
import pytest
import torch
from env.crawler import Crawl, differing

from sim.actuators import torques
from sim.small_envs import ACTUATORS, ASSETS, env_config, env_of, physics_step
from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.sim.actuators import network_actuators

MOTOR = {"effort_limit": 1e6, "velocity_limit": 1e6, "saturation_effort": 1e6}
LSTM = {"_target_": ACTUATORS + "ActuatorNetLSTM", "joint_names_expr": [".*_hip"], "network_file": "nets/hip.pt"}
LSTM |= MOTOR
MLP = {**LSTM, "_target_": ACTUATORS + "ActuatorNetMLP", "pos_scale": 2.0, "vel_scale": 0.1, "torque_scale": 3.0}
MLP |= {"input_order": "pos_vel", "input_idx": [0, 1, 3]}


@pytest.fixture
def made(tmp_path, monkeypatch):
    def make(node, module, **changes):
        if not isinstance(module, (torques.Endless, torques.Growing)):  # A child process needs 2 s to start.
            monkeypatch.setattr(network_actuators, "call_limited", lambda load, *words, **_: load(*words))
        shutil.copyfile(ASSETS / "rover.xml", tmp_path / "rover.xml")
        torques.written(module, tmp_path / "networks" / "nets" / "hip.pt")
        config = env_config(**changes)
        config["robot"]["actuators"]["hips"] = node
        env = env_of(tmp_path / "rover.xml", config)
        env.reset()
        return env

    return make


def stepped(env, count):
    robot, data, generator = env.scene.robot, env.scene.robot.data, torch.Generator().manual_seed(1)
    ids = robot.actuators["hips"].joint_ids
    for _ in range(count):
        robot.set_joint_position_target(torch.randn(4, 4, generator=generator), slice(None))
        error, speed = robot.targets.pos[:, ids] - data.joint_pos[:, ids], data.joint_vel[:, ids].clone()
        physics_step(env)
        yield error.numpy(), speed.numpy(), data.computed_torque[:, ids].numpy(), data.applied_torque[:, ids].numpy()


@pytest.mark.parametrize("order", ["pos_vel", "vel_pos"])
def test_a_perceptron_sees_errors_and_speeds_of_chosen_steps(made, order):
    module = torques.perceptron()
    env = made({**MLP, "input_order": order}, module)
    w1, b1, w2, b2 = (p.detach().double().numpy() for p in module.parameters())
    errors, speeds = [np.zeros((4, 2))] * 3, [np.zeros((4, 2))] * 3
    for error, speed, computed, applied in stepped(env, 8):
        errors, speeds = [error, *errors], [speed, *speeds]
        pos = np.stack([2.0 * errors[k] for k in (0, 1, 3)], axis=-1)
        vel = np.stack([0.1 * speeds[k] for k in (0, 1, 3)], axis=-1)
        x = np.concatenate([pos, vel] if order == "pos_vel" else [vel, pos], axis=-1)
        hidden = x @ w1.T + b1
        torque = 3.0 * (hidden / (1 + np.abs(hidden)) @ w2.T + b2)[..., 0]  # softsign
        np.testing.assert_allclose(computed, torque, atol=1e-4)
        np.testing.assert_allclose(applied, torque, atol=1e-4)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def test_an_lstm_remembers_each_joint_of_each_environment(made):
    module = torques.recurrent()
    env = made(LSTM, module)
    weights = {name: p.detach().double().numpy() for name, p in module.named_parameters()}
    hidden, cell = np.zeros((2, 4, 2, 8)), np.zeros((2, 4, 2, 8))

    def run(error, speed):
        x = np.stack([error, speed], axis=-1)
        for layer in range(2):
            w, u = weights[f"lstm.weight_ih_l{layer}"], weights[f"lstm.weight_hh_l{layer}"]
            gates = x @ w.T + hidden[layer] @ u.T
            gates += weights[f"lstm.bias_ih_l{layer}"] + weights[f"lstm.bias_hh_l{layer}"]
            i, f, g, o = np.split(gates, 4, axis=-1)
            cell[layer] = sigmoid(f) * cell[layer] + sigmoid(i) * np.tanh(g)
            x = hidden[layer] = sigmoid(o) * np.tanh(cell[layer])
        return (x @ weights["out.weight"].T + weights["out.bias"])[..., 0]

    for error, speed, computed, _ in stepped(env, 6):
        np.testing.assert_allclose(computed, run(error, speed), atol=1e-4)
    env.scene.robot.actuators["hips"].begin(torch.tensor([1, 2]))
    hidden[:, 1:3], cell[:, 1:3] = 0.0, 0.0
    for error, speed, computed, _ in stepped(env, 3):
        np.testing.assert_allclose(computed, run(error, speed), atol=1e-4)


def test_the_past_of_a_perceptron_is_forgotten_with_its_episode(made):
    env = made(MLP, torques.perceptron())
    list(stepped(env, 5))
    hips = env.scene.robot.actuators["hips"]
    hips.begin(torch.tensor([0, 3]))
    assert hips._past.flatten(1).any(dim=1).tolist() == [False, True, True, False]


def test_a_networks_output_is_bounded_by_the_motors_line(made):
    module = torques.perceptron()
    with torch.no_grad():
        module[2].weight.zero_()
        module[2].bias.fill_(50.0)
    motor = {"effort_limit": 4.0, "velocity_limit": 30.0, "saturation_effort": 6.0}
    env = made({**MLP, **motor, "torque_scale": 1.0}, module)
    robot, data = env.scene.robot, env.scene.robot.data
    robot.write_joint_state_to_sim(data.joint_pos, torch.full((4, 4), 20.0), env_ids=torch.arange(4))
    data.invalidate()
    *_, computed, applied = next(iter(stepped(env, 1)))
    np.testing.assert_allclose(computed, 50.0)
    np.testing.assert_allclose(applied, 6.0 * (1 - 20.0 / 30.0), rtol=1e-5)


@pytest.mark.parametrize(("node", "module"), [(MLP, torques.perceptron()), (LSTM, torques.recurrent())])
def test_a_restored_network_continues_as_if_it_had_never_stopped(made, node, module):
    node = {**node, "delay": [0, 2]}
    env = made(node, module)
    list(stepped(env, 7))
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    other = made(node, module)
    list(stepped(other, 3))
    other.load_state_dict(torch.load(file, weights_only=True))
    assert differing(*map(Crawl, [e.scene.robot.actuators["hips"] for e in (env, other)])) == []
    for one, two in zip(stepped(env, 5), stepped(other, 5), strict=True):
        assert all(map(np.array_equal, one, two))


def test_a_networks_weights_are_in_no_state(made):
    saved = made(LSTM, torques.recurrent()).state_dict()["scene"]["robot"]["actuators"]["hips"]
    assert saved.keys() == {"_hidden", "_cell", "_computed"}


@pytest.mark.parametrize(
    ("node", "module", "words"),
    [
        (MLP, torques.WritesAFile(), "aten::from_file"),
        (MLP, torques.RunsAtLoading(), "__setstate__"),
        (MLP, torques.Endless(), "prim::Loop"),
        (MLP, torques.Growing(), "rejects its inputs.*memory"),
        (MLP, torques.Repeating(), "repeat fewer stored numbers"),
        (MLP, torques.perceptron(inputs=5), "rejects its inputs"),
        (MLP, torques.perceptron(outputs=2), "2 numbers for one joint"),
        (LSTM, torques.perceptron(), "no LSTM"),
        *(
            ({**MLP, "network_file": file}, torques.perceptron(), "below a folder")
            for file in ("../hip.pt", "/hip.pt", "nets/../../hip.pt", "")
        ),
    ],
)
def test_a_wrong_network_is_rejected_before_it_runs(made, node, module, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=words) as caught:
        made(node, module)
    assert caught.value.key == "env.robot.actuators.hips.network_file"
    assert not (tmp_path / "written_by_a_network").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x05\x06", b"not a network" * 100])
def test_a_file_that_is_not_torchscript_is_rejected(made, tmp_path, content):
    made(MLP, torques.perceptron())
    (tmp_path / "networks" / "nets" / "hip.pt").write_bytes(content)
    config = env_config()
    config["robot"]["actuators"]["hips"] = MLP
    with pytest.raises(ConfigError, match="as a TorchScript network") as caught:
        env_of(tmp_path / "rover.xml", config)
    assert "\n" not in caught.value.message


def test_a_network_that_grows_without_end_while_it_is_loaded_is_rejected(tmp_path, monkeypatch):
    limited = network_actuators.call_limited
    monkeypatch.setattr(network_actuators, "call_limited", lambda *a, **k: limited(*a, **{**k, "seconds": 4}))
    torques.doubling(tmp_path / "networks" / "nets" / "hip.pt", 40)
    actuator = network_actuators.ActuatorNetMLP(**{name: value for name, value in MLP.items() if name != "_target_"})
    with pytest.raises(WheellegError, match="CPU time") as caught:
        actuator.read_files(tmp_path, "key", torch.device("cpu"))
    assert caught.value.key == "key.network_file"
