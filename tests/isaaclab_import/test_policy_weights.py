"""The networks of policy files compute what the original modules compute."""

from __future__ import annotations

import os
import resource
import zipfile
from pathlib import Path

import onnx
import pytest
import torch

from tests.isaaclab_import.runs import ActorCritic, Exported, Normalizer, checkpoint
from tests.isaaclab_import.test_author_runners import write_network
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.isaaclab_import.policy_weights import Network, read_policy
from wheelleg_exp.isaaclab_import.run_folder import _policy


def outputs(network: Network, x: torch.Tensor) -> torch.Tensor:
    """Compute a network's outputs from its layers."""
    if network.mean is not None and network.deviation is not None:
        x = (x - network.mean) / (network.deviation + 1e-2)
    for number, (weight, bias) in enumerate(network.layers):
        x = torch.nn.functional.linear(x, weight, bias)
        x = torch.nn.functional.elu(x) if number + 1 < len(network.layers) else x
    return x


X = torch.linspace(-2, 2, 75).reshape(3, 25)


def test_checkpoint_of_rsl_rl_2(tmp_path: Path) -> None:
    policy = ActorCritic()
    torch.save(checkpoint(policy, 70), tmp_path / "model_70.pt")
    found = read_policy(tmp_path / "model_70.pt")
    assert found.critic is not None
    assert found.std is not None
    torch.testing.assert_close(outputs(found.actor, X), policy.actor(X))
    torch.testing.assert_close(outputs(found.critic, X), policy.critic(X))
    torch.testing.assert_close(found.std, policy.std.detach())
    assert (found.iteration, found.actor.hidden, found.actor.widths) == (70, [32, 16], (25, 6))


@pytest.mark.parametrize("form", ["inside", "beside"])
def test_normalization_of_rsl_rl(tmp_path: Path, form: str) -> None:
    policy, normalizer = ActorCritic(), Normalizer()
    state = checkpoint(policy)
    if form == "inside":  # rsl_rl 3
        state["model_state_dict"] |= {f"actor_obs_normalizer.{k}": v for k, v in normalizer.state_dict().items()}
    else:  # rsl_rl 2
        state["obs_norm_state_dict"] = normalizer.state_dict()
    torch.save(state, tmp_path / "model_1.pt")
    found = read_policy(tmp_path / "model_1.pt")
    torch.testing.assert_close(outputs(found.actor, X), policy.actor(normalizer(X)))
    assert found.actor.count == 5000


def test_logarithm_of_the_deviation(tmp_path: Path) -> None:
    state = checkpoint(ActorCritic())
    state["model_state_dict"]["log_std"] = state["model_state_dict"].pop("std").log()
    torch.save(state, tmp_path / "model_1.pt")
    found = read_policy(tmp_path / "model_1.pt").std
    assert found is not None
    assert torch.allclose(found, torch.full((6,), 0.3), atol=0.01)


class ExportedNow(torch.nn.Module):
    """A policy as rsl_rl 4 and later export it."""

    def __init__(self, actor: torch.nn.Module, normalizer: torch.nn.Module) -> None:
        super().__init__()
        self.obs_normalizer, self.mlp = normalizer, actor

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.mlp(self.obs_normalizer(x))


@pytest.mark.parametrize("form", [Exported, ExportedNow])
@pytest.mark.parametrize("normalizer", [torch.nn.Identity(), Normalizer()])
def test_torchscript(tmp_path: Path, normalizer: torch.nn.Module, form: type[torch.nn.Module]) -> None:
    policy = form(ActorCritic().actor, normalizer)
    torch.jit.script(policy).save(str(tmp_path / "policy.pt"))
    found = read_policy(tmp_path / "policy.pt")
    torch.testing.assert_close(outputs(found.actor, X), policy(X))
    assert found.activation == "elu"
    assert found.critic is None
    assert found.std is None


class Writes(Exported):
    """A policy whose code runs when torch loads its file."""

    def __init__(self) -> None:
        super().__init__(ActorCritic().actor, torch.nn.Identity())

    @torch.jit.export
    def __getstate__(self) -> tuple[torch.Tensor, bool]:
        return torch.ones(1), self.training

    @torch.jit.export
    def __setstate__(self, state: tuple[torch.Tensor, bool]) -> None:
        assert not state[1], "the code of the file was executed"


def test_code_of_torchscript_is_not_executed(tmp_path: Path) -> None:
    torch.jit.script(Writes()).save(str(tmp_path / "policy.pt"))
    with pytest.raises(torch.jit.Error, match="was executed"):
        torch.jit.load(str(tmp_path / "policy.pt"))
    with pytest.raises(RunDirectoryError, match=r"no multilayer perceptron|cannot be read"):
        read_policy(tmp_path / "policy.pt")


@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("form", ["Gemm", "MatMul"])
def test_onnx(tmp_path: Path, normalized: bool, form: str) -> None:
    import numpy as np
    import onnx
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    actor, normalizer = ActorCritic().actor, Normalizer()
    nodes, values, last = [], {}, "obs"
    if normalized:
        values |= {"mean": normalizer._mean.numpy(), "scale": (normalizer._std + 1e-2).numpy()}
        nodes += [helper.make_node("Sub", ["obs", "mean"], ["a"]), helper.make_node("Div", ["a", "scale"], ["b"])]
        last = "b"
    for number in (0, 2, 4):
        weight, bias = (actor[number].get_parameter(name).detach().numpy() for name in ("weight", "bias"))
        values |= {f"w{number}": weight if form == "Gemm" else weight.T, f"b{number}": bias}
        if form == "Gemm":
            nodes.append(helper.make_node("Gemm", [last, f"w{number}", f"b{number}"], [f"y{number}"], transB=1))
        else:
            nodes.append(helper.make_node("MatMul", [last, f"w{number}"], [f"m{number}"]))
            nodes.append(helper.make_node("Add", [f"m{number}", f"b{number}"], [f"y{number}"]))
        last = f"y{number}"
        if number < 4:
            nodes.append(helper.make_node("Elu", [last], [f"e{number}"]))
            last = f"e{number}"
    ends = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [None, w]) for n, w in (("obs", 25), (last, 6))]
    stored = [numpy_helper.from_array(np.ascontiguousarray(value), name) for name, value in values.items()]
    graph = helper.make_graph(nodes, "policy", ends[:1], ends[1:], stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(tmp_path / "policy.onnx"))
    found = read_policy(tmp_path / "policy.onnx")
    expected = onnxruntime.InferenceSession(str(tmp_path / "policy.onnx")).run(None, {"obs": X.numpy()})[0]
    torch.testing.assert_close(outputs(found.actor, X), torch.tensor(expected), atol=1e-5, rtol=1e-5)
    assert found.activation == "elu"


@pytest.mark.parametrize("change", ["tanh at the end", "other slope", "mixed", "unknown"])
def test_other_activations_are_refused(tmp_path: Path, change: str) -> None:
    actor = ActorCritic().actor
    if change == "tanh at the end":
        actor.append(torch.nn.Tanh())
    else:
        actor[1] = {"other slope": torch.nn.ELU(0.5), "mixed": torch.nn.ReLU(), "unknown": torch.nn.SiLU()}[change]
    torch.jit.script(Exported(actor, torch.nn.Identity())).save(str(tmp_path / "policy.pt"))
    with pytest.raises(RunDirectoryError, match="activations"):
        read_policy(tmp_path / "policy.pt")


def test_normalization_of_the_critic(tmp_path: Path) -> None:
    policy, normalizer = ActorCritic(), Normalizer()
    for key in ("privileged_obs_norm_state_dict", "critic_obs_norm_state_dict"):
        torch.save(checkpoint(policy) | {key: normalizer.state_dict()}, tmp_path / "model_1.pt")
        found = read_policy(tmp_path / "model_1.pt").critic
        assert found is not None
        torch.testing.assert_close(outputs(found, X), policy.critic(normalizer(X)))


def test_bad_files(tmp_path: Path) -> None:
    recurrent = {"model_state_dict": {"memory_a.rnn.weight_ih_l0": torch.ones(2, 2)}, "iter": 1}
    bad: dict[str, object] = {"recurrent": recurrent, "a list": [1, 2], "no networks": {"iter": 3}}
    for name, content in bad.items():
        torch.save(content, tmp_path / "model_1.pt")
        with pytest.raises(RunDirectoryError) as error:
            read_policy(tmp_path / "model_1.pt")
        assert ("recurrent" in str(error.value)) == (name == "recurrent")
    texts = {b"version https://git-lfs.github.com/spec/v1": "pointer of Git LFS"}
    texts[b"\x80\x04x"] = "cannot be read|no linear layers"
    for data, words in texts.items():
        for file in ("policy.pt", "policy.onnx"):
            (tmp_path / file).write_bytes(data)
            with pytest.raises(RunDirectoryError, match=words):
                read_policy(tmp_path / file)


@pytest.mark.parametrize("change", ["external data", "huge shape"])
def test_an_onnx_file_reads_no_other_file_and_little_memory(tmp_path: Path, change: str) -> None:
    write_network(tmp_path / "policy.onnx", [4, 8, 2])
    model = onnx.load(tmp_path / "policy.onnx")
    tensor = model.graph.initializer[0]
    if change == "huge shape":
        tensor.dims[:] = [10**6, 10**6]
    else:
        (tmp_path / "secret").write_bytes(tensor.raw_data)
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="secret")
    (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(RunDirectoryError, match="damaged"):
        read_policy(tmp_path / "policy.onnx")


def _doubled(count: int) -> bytes:
    """Return a pickle of modules, each of which holds the one before it twice: 2^count names."""
    text = b"\x80\x02c__torch__\nA\n)\x81}bq\x00"
    for number in range(count):
        text += b"c__torch__\nA\n)\x81}(" + b"".join(b"U\x01" + name + b"h%c" % number for name in (b"a", b"b"))
        text += b"ubq%c" % (number + 1)
    return text + b"."


def _with_pickle(path: Path, text: bytes, *, script: bool) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("p/data.pkl", text)
        archive.writestr("p/version", "3\n")
        archive.writestr("p/code/a.py" if script else "p/byteorder", "little")
    return path


MEMO = b"\x80\x02Nr\xff\xff\xff\x0f."  # a LONG_BINPUT, for which C's unpickler allocates 4 GiB
BYTES = b"\x80\x02cbuiltins\nbytearray\n\x8a\x05\x00\x00\x00\x00\x02\x85R."  # bytearray(2**33)


@pytest.mark.parametrize(
    ("text", "script"), [(_doubled(60), True), (MEMO, True), (MEMO, False), (BYTES, True), (BYTES, False)]
)
def test_a_small_file_cannot_take_much_memory_or_time(tmp_path: Path, text: bytes, script: bool) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(RunDirectoryError):
        read_policy(_with_pickle(tmp_path / "policy.pt", text, script=script))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10


@pytest.mark.parametrize(
    ("seen", "hidden", "normalized", "message"),
    [
        (4, 5, "policy", "normalizes its observations"),
        (4, 5, "encoder", "normalizes its observations"),
        (20_000, 1, "", "too wide"),
        (1, 20_000, "", "too wide"),
    ],
)
def test_networks_that_cannot_be_merged_are_refused(
    tmp_path: Path, seen: int, hidden: int, normalized: str, message: str
) -> None:
    write_network(tmp_path / "policy.onnx", [2 + seen + 3, hidden, 1], normalized=normalized == "policy")
    write_network(tmp_path / "encoder.onnx", [2 * seen, hidden, 2], normalized=normalized == "encoder")
    with pytest.raises(RunDirectoryError, match=message):
        read_policy(tmp_path / "policy.onnx", encoded=True)
    assert read_policy(tmp_path / "policy.onnx").actor.widths == (2 + seen + 3, 1)  # without the encoder


def test_weights_that_repeat_one_number_are_refused(tmp_path: Path) -> None:
    one = torch.ones(1, 1)
    wide = {"actor.0.weight": one.expand(100_000, 100_000), "actor.0.bias": one[0].expand(100_000)}
    torch.save({"model_state_dict": wide}, tmp_path / "model_1.pt")
    with pytest.raises(RunDirectoryError):
        read_policy(tmp_path / "model_1.pt")


def test_pipes_and_devices_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "model_7.pt")
    for path in (tmp_path / "model_7.pt", Path("/dev/zero")):
        with pytest.raises(RunDirectoryError, match="not an ordinary file"):
            read_policy(path)
    assert _policy(tmp_path, {}) is None
