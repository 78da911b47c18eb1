"""Read the networks of a policy from a checkpoint of rsl_rl, a TorchScript file, or an ONNX file, without running it.

Only multilayer perceptrons are read: linear layers with one activation between them, and optional normalization.
"""

from __future__ import annotations

import io
import math
import pickle
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import open_file, read_bytes
from wheelleg_exp.isaaclab_import.run_folder import LFS
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.rl.checkpoint import read_tensors

_LONGEST_PREFIX = 1_000  # letters of the names of all modules that contain a module
_EPSILON = 1e-2  # rsl_rl divides by the standard deviation plus this number.
_LAYER = re.compile(r"(?:fc)?(\d+)\.(weight|bias)")
_CONSTANT = re.compile(r"(alpha|negative_slope) : Final\[float\] = ([\d.e-]+)")  # in the code of a TorchScript file
_PARTS = ("actor", "critic", "std", "log_std", "mlp", "distribution")  # besides normalizers
_ACTIVATIONS = {
    "Elu": "elu", "ELU": "elu", "Relu": "relu", "ReLU": "relu", "Tanh": "tanh", "LeakyRelu": "lrelu",
    "LeakyReLU": "lrelu", "Selu": "selu", "SELU": "selu", "Sigmoid": "sigmoid",
}  # fmt: skip
_LARGEST = 10_000_000  # square of the largest width, times the number of the encoder's layers
_COMMANDS = 3  # components of LimX's command
_OFFSET, _ACTION_OFFSET = 8.0, 64.0  # above the absolute values of LimX's observations, and of actions
_IDENTITY = ("elu", "relu", "lrelu")  # activations that do not change positive numbers
_STORED = {
    "FloatStorage": torch.float32, "DoubleStorage": torch.float64, "HalfStorage": torch.float16,
    "LongStorage": torch.int64, "IntStorage": torch.int32, "BoolStorage": torch.bool,
}  # fmt: skip
_EXPECTED = "a model_<iteration>.pt of rsl_rl, or a policy.pt or policy.onnx that Isaac Lab exported"


@dataclass
class Network:
    """A multilayer perceptron: weights and biases of each layer, and the observation's mean and deviation (or None)."""

    layers: list[tuple[torch.Tensor, torch.Tensor]]
    mean: torch.Tensor | None = None
    deviation: torch.Tensor | None = None
    count: int = 0

    @property
    def hidden(self) -> list[int]:
        """The numbers of units of the hidden layers."""
        return [len(bias) for _, bias in self.layers[:-1]]

    @property
    def widths(self) -> tuple[int, int]:
        """The numbers of inputs and outputs."""
        return self.layers[0][0].shape[1], len(self.layers[-1][1])

    def state(self) -> dict[str, torch.Tensor]:
        """Return the parameters with the names of rsl_rl's MLPModel."""
        found: dict[str, torch.Tensor] = {}
        if self.mean is not None and self.deviation is not None:
            mean, deviation = self.mean.reshape(1, -1), self.deviation.reshape(1, -1)
            found |= {"obs_normalizer._mean": mean, "obs_normalizer._var": deviation**2}
            found |= {"obs_normalizer._std": deviation, "obs_normalizer.count": torch.tensor(self.count)}
        for number, (weight, bias) in enumerate(self.layers):
            found |= {f"mlp.{2 * number}.weight": weight, f"mlp.{2 * number}.bias": bias}
        return {name: value.detach().clone().contiguous() for name, value in found.items()}


@dataclass
class PolicyWeights:
    """The networks of a policy file; ``std`` is the standard deviation of each action, ``activation`` rsl_rl's name."""

    path: Path
    actor: Network
    critic: Network | None = None
    std: torch.Tensor | None = None
    activation: str | None = None
    optimizer: Mapping[str, object] | None = None
    iteration: int = 0
    log_std: bool = False  # whether the file has the logarithm of ``std``


def read_policy(path: Path, *, encoded: bool = False) -> PolicyWeights:
    """Read a policy file, and if ``encoded``, LimX's ``encoder.onnx`` next to it.

    RunDirectoryError means that a file is damaged, or contains another kind of network.
    """
    with open_file(path) as stream:
        start = stream.read(len(LFS))
    if start == LFS:
        message = "the file is a pointer of Git LFS, not the policy"
        raise RunDirectoryError(message, key=str(path), expected="git lfs pull")
    try:
        found = _from_onnx(path) if path.suffix == ".onnx" else _tensors(path)
        encoder = path.with_name("encoder.onnx")
        return _with_encoder(found, _from_onnx(encoder)) if encoded and encoder.is_file() else found
    except RunDirectoryError:
        raise
    except Exception as error:  # Damaged files raise many types of errors.
        message = "the policy cannot be read: the file is damaged, or no policy"
        raise RunDirectoryError(message, key=str(path), expected=_EXPECTED) from error


def _with_encoder(policy: PolicyWeights, encoder: PolicyWeights) -> PolicyWeights:
    """Return LimX's policy and its encoder as one network.

    The policy observes the encoder's output, the newest observation, and the command; the encoder, successive
    observations, the oldest first. The one network observes successive pairs of an observation and a command. Its
    units next to the encoder's are x + offset > 0, which the activation does not change, for each x of the newest pair.
    """
    inner, outer = encoder.actor.layers, policy.actor.layers
    if any(one.actor.mean is not None for one in (policy, encoder)):
        message, expected = "the policy or its encoder normalizes its observations", "networks of LimX, which do not"
        raise RunDirectoryError(message, key=str(policy.path), expected=expected)
    widest = max(width for one in (policy.actor, encoder.actor) for width in (*one.widths, *one.hidden))
    if widest**2 * len(inner) > _LARGEST:  # Layers of the one network grow with the square of a width.
        message = f"the policy and its encoder are too wide to be one network: {widest} units"
        raise RunDirectoryError(message, key=str(policy.path), expected="networks of LimX")
    width, code, actions = policy.actor.widths[0], encoder.actor.widths[1], policy.actor.widths[1]
    seen = width - code - _COMMANDS
    if encoder.activation != policy.activation or policy.activation not in _IDENTITY or encoder.actor.widths[0] % seen:
        message = "the encoder does not read successive observations of the policy, with the policy's activation"
        raise RunDirectoryError(message, key=str(encoder.path), expected="an encoder of LimX")
    newest, frame = torch.eye(seen + _COMMANDS), seen + _COMMANDS
    columns = torch.arange(encoder.actor.widths[0] // seen * frame).reshape(-1, frame)
    first = torch.zeros(inner[0][0].shape[0], columns.numel())
    first[:, columns[:, :seen].flatten()] = inner[0][0]
    offset = torch.full((frame,), _OFFSET)
    offset[seen - actions : seen] = _ACTION_OFFSET
    passed_on = torch.zeros(frame, columns.numel())
    passed_on[:, columns[-1]] = newest
    layers = [(torch.cat((first, passed_on)), torch.cat((inner[0][1], offset)))]
    layers += [
        (torch.block_diag(weight, newest), torch.cat((bias, torch.zeros(frame)))) for weight, bias in inner[1:-1]
    ]
    (weight, bias), (ahead, constant) = inner[-1], outer[0]
    last = torch.cat((ahead[:, :code] @ weight, ahead[:, code:]), 1)
    layers += [(last, constant + ahead[:, :code] @ bias - ahead[:, code:] @ offset), *outer[1:]]
    return PolicyWeights(policy.path, Network(layers), activation=policy.activation)


def _tensors(path: Path) -> PolicyWeights:
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            require_bounded(archive)
            code = [name for name in archive.namelist() if "/code/" in name]
            if code:
                return _from_torchscript(path, archive, code[0].split("/code/")[0])
    state = read_tensors(path)
    if not isinstance(state, Mapping):
        raise RunDirectoryError("the file contains no networks", key=str(path), expected=_EXPECTED)
    whole = state.get("model_state_dict", state)
    if "actor_state_dict" in state:  # rsl_rl since 4.0
        actor, critic = state["actor_state_dict"], state.get("critic_state_dict") or {}
        found = PolicyWeights(path, _network(actor, "mlp", "obs_normalizer", path))
        found.critic = _network(critic, "mlp", "obs_normalizer", path) if critic else None
        std, log_std = actor.get("distribution.std_param"), actor.get("distribution.log_std_param")
    else:
        found = PolicyWeights(path, _network(whole, "actor", "actor_obs_normalizer", path))
        if any(name.startswith("critic.") for name in whole):
            found.critic = _network(whole, "critic", "critic_obs_normalizer", path)
        std, log_std = whole.get("std"), whole.get("log_std")
        keys = ((found.actor, "obs_norm_state_dict"), (found.critic, "privileged_obs_norm_state_dict"))
        for network, key in (*keys, (found.critic, "critic_obs_norm_state_dict")):
            if network is not None and isinstance(state.get(key), Mapping):  # rsl_rl before 3.0
                _normalize(network, state[key], "")
    found.std, found.log_std = std, std is None and log_std is not None
    if found.log_std:
        found.std = log_std.exp()
    found.iteration = int(state.get("iter", 0))
    found.optimizer = state.get("optimizer_state_dict")
    return found


class _Module:
    """A module of a TorchScript file: only its attributes are read, and its code is not."""

    def parts(self) -> Iterator[tuple[str, object]]:
        """Yield the names and values of all attributes, also of inner modules; of a shared inner module only once."""
        waiting, seen = [("", self)], {id(self)}
        while waiting:
            prefix, module = waiting.pop()
            for name, value in vars(module).items():
                yield f"{prefix}{name}", value
                if isinstance(value, _Module) and id(value) not in seen and len(prefix) < _LONGEST_PREFIX:
                    waiting.append((f"{prefix}{name}.", value))
                    seen.add(id(value))


class _TensorsOnly(pickle._Unpickler):  # pickle.Unpickler allocates as much memory as an opcode of a file requests.
    """Reads the tensors and the tree of modules of a TorchScript file; any other object is refused."""

    def __init__(self, archive: zipfile.ZipFile, root: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{root}/data.pkl")))
        self._archive, self._root = archive, root

    def find_class(self, module: str, name: str) -> object:
        """Return a harmless substitute for a class or function of the file, or refuse it."""
        if module.startswith("__torch__"):
            return type(name, (_Module,), {})
        if name.endswith("Storage") and (dtype := _STORED.get(name)):
            return dtype
        known = {"_rebuild_tensor_v2": _tensor, "OrderedDict": dict, "build_intlist": list, "build_doublelist": list}
        if name not in known:
            raise pickle.UnpicklingError(f"the file contains the object {module}.{name}")
        return known[name]

    def persistent_load(self, pid: tuple[str, torch.dtype, str]) -> torch.Tensor:
        data = self._archive.read(f"{self._root}/data/{pid[2]}")
        return torch.frombuffer(bytearray(data), dtype=pid[1]) if data else torch.empty(0, dtype=pid[1])


def _tensor(storage: torch.Tensor, offset: int, size: Sequence[int], stride: Sequence[int], *_: object) -> torch.Tensor:
    if math.prod(size) > storage.numel():
        raise pickle.UnpicklingError("the file contains a tensor that repeats fewer stored numbers")
    return storage.as_strided(tuple(size), tuple(stride), offset)


def _from_torchscript(path: Path, archive: zipfile.ZipFile, root: str) -> PolicyWeights:
    parts = list(_TensorsOnly(archive, root).load().parts())
    tensors = {name: value for name, value in parts if isinstance(value, torch.Tensor)}
    names = ("mlp", "obs_normalizer") if any(name.startswith("mlp.") for name in tensors) else ("actor", "normalizer")
    found = PolicyWeights(path, _network(tensors, *names, path))
    layers = [(int(name.split(".")[1]), value) for name, value in parts if re.fullmatch(rf"{names[0]}\.\d+", name)]
    between = [value for _, value in sorted(layers, key=lambda layer: layer[0]) if type(value).__name__ != "Linear"]
    if layers and len(layers) != 2 * len(found.actor.layers) - 1:
        between.append(_Module())  # an activation after the last layer
    code = "".join(archive.read(name).decode(errors="replace") for name in archive.namelist() if name.endswith(".py"))
    settings = [{name: float(number)} for name, number in _CONSTANT.findall(code)]
    kinds = [type(value).__name__ for value in between]
    found.activation = _one_activation([(kind, one) for kind in kinds for one in settings or [{}]], path)
    return found


def _one_activation(found: list[tuple[str, Mapping[str, object]]], path: Path) -> str | None:
    """Return rsl_rl's name of the activation between all layers; refuse anything else than one usual activation."""
    kinds = {kind for kind, _ in found}
    for kind, settings in found:
        usual = settings.get("alpha", 1.0) == 1.0 and settings.get("negative_slope", 0.01) == 0.01
        if kind not in _ACTIVATIONS or not usual or len(kinds) > 1:
            message = f"the policy has the activations {', '.join(sorted(kinds))}"
            known = ", ".join(sorted(set(_ACTIVATIONS.values())))
            expected = f"one of {known} between all layers, with its usual settings"
            raise RunDirectoryError(message, key=str(path), expected=expected)
    return _ACTIVATIONS[found[0][0]] if found else None


def _network(state: Mapping[str, object], prefix: str, normalizer: str, path: Path) -> Network:
    if any("rnn." in name or name.startswith("memory") for name in state):
        raise RunDirectoryError("the policy is recurrent", key=str(path), expected="a multilayer perceptron")
    more = [part for name in state if (part := name.split(".")[0]) not in _PARTS and "normalizer" not in part]
    if more:
        message = f"the policy has another network, '{more[0]}'"
        raise RunDirectoryError(message, key=str(path), expected="a multilayer perceptron")
    layers: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in state.items():
        found = _LAYER.fullmatch(name.removeprefix(f"{prefix}.")) if name.startswith(f"{prefix}.") else None
        if found and isinstance(value, torch.Tensor):
            layers.setdefault(int(found[1]), {})[found[2]] = value.float()
    made = [(part["weight"], part["bias"]) for _, part in sorted(layers.items()) if len(part) == 2]
    joined = all(a[0].shape[0] == b[0].shape[1] for a, b in pairwise(made))
    if not made or len(made) != len(layers) or not joined:
        raise RunDirectoryError(f"the file has no multilayer perceptron '{prefix}'", key=str(path), expected=_EXPECTED)
    network = Network(made)
    _normalize(network, state, f"{normalizer}.")
    return network


def _normalize(network: Network, state: Mapping[str, object], prefix: str) -> None:
    if f"{prefix}_mean" in state:
        mean, deviation = (torch.as_tensor(state[f"{prefix}{name}"]).float() for name in ("_mean", "_std"))
        count = int(torch.as_tensor(state.get(f"{prefix}count", 0)))
        network.mean, network.deviation, network.count = mean, deviation, count


def _from_onnx(path: Path) -> PolicyWeights:
    import onnx
    from onnx import numpy_helper

    graph = onnx.load_from_string(read_bytes(path)).graph
    values = {item.name: torch.tensor(numpy_helper.to_array(item)) for item in graph.initializer}
    for node in graph.node:
        if node.op_type == "Constant":
            values[node.output[0]] = torch.tensor(numpy_helper.to_array(node.attribute[0].t))
    layers, network = list[tuple[torch.Tensor, torch.Tensor]](), Network([])
    activations = list[tuple[str, Mapping[str, object]]]()
    current, pending = None, None
    for node in graph.node:
        known = [values[name].float() for name in node.input if name in values]
        kind = node.op_type
        if current is not None and current not in node.input and kind != "Constant":
            continue  # not on the way from the observation to the action
        if kind == "Gemm" and len(known) == 2:
            transposed = any(item.name == "transB" and item.i for item in node.attribute)
            layers.append((known[0] if transposed else known[0].T, known[1]))
        elif kind == "MatMul" and len(known) == 1:
            pending = known[0].T
        elif kind == "Add" and pending is not None and len(known) == 1:
            layers.append((pending, known[0].reshape(-1)))
            pending = None
        elif kind == "Sub" and len(known) == 1 and not layers:
            network.mean = known[0].reshape(-1)
        elif kind == "Div" and len(known) == 1 and not layers:
            network.deviation = known[0].reshape(-1) - _EPSILON
        elif kind in _ACTIVATIONS:
            settings = {item.name: item.f for item in node.attribute}
            slope = settings.get("alpha", 0.01) if kind == "LeakyRelu" else 0.01
            alpha = 1.0 if kind in ("LeakyRelu", "Selu") else settings.get("alpha", 1.0)
            activations.append((kind, {"alpha": alpha, "negative_slope": slope}))
        elif kind not in ("Constant", "Identity", "Cast", "Flatten", "Squeeze"):
            message = f"the policy has the operation '{kind}'"
            raise RunDirectoryError(message, key=str(path), expected="a multilayer perceptron")
        current = node.output[0] if kind != "Constant" else current
    if not layers:
        raise RunDirectoryError("the policy has no linear layers", key=str(path), expected=_EXPECTED)
    if (network.mean is None) != (network.deviation is None):
        raise RunDirectoryError("the policy's normalization is not rsl_rl's", key=str(path), expected=_EXPECTED)
    if len(activations) != len(layers) - 1:
        activations.append(("another operation", {}))  # after the last layer, or missing between two layers
    network.layers = layers
    return PolicyWeights(path, network, activation=_one_activation(activations, path))
