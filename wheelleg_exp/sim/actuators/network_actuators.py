"""Learned drives: networks trained on a real drive's measurements, in ``NETWORKS`` next to the robot's MJCF file."""

from __future__ import annotations

import io
import math
import pickle
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from zipfile import BadZipFile, ZipFile

import torch

from wheelleg_exp.child_process import call_limited
from wheelleg_exp.constraints import Names, Natural, NotEmpty, PathBelow, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.files import read_bytes, sha256
from wheelleg_exp.paths import NETWORKS
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.sim.actuators.actuator_base import Delay, LimitPerJoint, PerJoint, Stream
from wheelleg_exp.sim.actuators.pd_actuators import DCMotor
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.robot_model import JointTargets

if TYPE_CHECKING:
    from wheelleg_exp.sim.articulation_data import ArticulationData


_LANGUAGE = frozenset(
    """Constant GetAttr If ListConstruct ListUnpack NumToTensor RaiseException TupleConstruct TupleIndex
    TupleUnpack Uninitialized device dtype min max unchecked_cast""".split()  # noqa: SIM905
)
_OPERATIONS = frozenset(
    """__contains__ __getitem__ __is__ __isnot__ __not__ __and__ __or__ Bool Float Int abs add addmm bmm cat celu chunk
    clamp clamp_max clamp_min clone contiguous cos detach dim div dropout elu eq exp expand expand_as flatten floordiv
    format ge gelu gru gru_cell gt hardsigmoid hardswish hardtanh index_select layer_norm le leaky_relu len linear list
    log lstm lstm_cell lt matmul maximum mean minimum mish mm mul narrow ne neg ones ones_like permute pow prelu relu
    relu6 repeat reshape rnn_relu rnn_relu_cell rnn_tanh rnn_tanh_cell rsqrt rsub select selu sigmoid silu sin size
    slice softplus split sqrt squeeze stack sub sum t tanh to transpose type_as unbind unsqueeze view where zeros
    zeros_like""".split()  # noqa: SIM905
)
_RUNS_AT_LOADING = b"__setstate__"
_TRIED: set[tuple[str, bytes]] = set()  # files and settings of the networks that this process has tried


class Network:
    """A neural network with constant weights, loaded from a TorchScript file.

    A TorchScript file can contain code that reads and writes files, even while torch loads it. Raise ConfigError, with
    the config key ``key``, for operations that neural networks do not need.
    """

    def __init__(self, file: Path, key: str, device: torch.device | None) -> None:
        self._key = key
        data = read_bytes(file)
        try:
            require_bounded(ZipFile(io.BytesIO(data)))
            reader = torch._C.PyTorchFileReader(io.BytesIO(data))
            code = (name for name in reader.get_all_records() if "code/" in name)
            if any(_RUNS_AT_LOADING in reader.get_record(name) for name in code):
                method = _RUNS_AT_LOADING.decode()
                raise self._refused(
                    f"the network file must not define the method '{method}', which torch runs while it loads the file"
                )
            module = torch.jit.load(io.BytesIO(data), map_location=device)
            graph = module.eval().inlined_graph
        except (RuntimeError, AttributeError, ValueError, BadZipFile) as error:
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise self._refused(f"torch cannot read '{file.name}' as a TorchScript network: {reason}") from error
        for kind in _kinds(graph):
            space, _, name = kind.partition("::")
            known = {"prim": _LANGUAGE, "aten": _OPERATIONS}.get(space, frozenset())
            if name not in known and name.removesuffix("_") not in known:
                raise self._refused(f"the network '{file.name}' contains the operation '{kind}', which is not allowed")
        weights = module.state_dict().values()
        if any(value.numel() * value.element_size() > value.untyped_storage().nbytes() for value in weights):
            raise self._refused(f"the network '{file.name}' has weights that repeat fewer stored numbers")
        self._module = module

    def _refused(self, message: str) -> ConfigError:
        return ConfigError(message, key=self._key, expected="a network of torch.nn's layers, saved by torch.jit.save")

    def weights(self) -> dict[str, torch.Tensor]:
        """Return the weights by name."""
        return dict(self._module.state_dict())

    def __call__(self, *inputs: Any) -> Any:
        """Run a neural network without TorchScript's optimisation passes, which change the last bits of the outputs."""
        with torch.no_grad(), torch.jit.optimized_execution(False):  # type: ignore[attr-defined]
            return self._module.forward(*inputs)

    def tried(self, *inputs: Any, count: int) -> Any:
        """Run a neural network once; raise ConfigError if the network fails or does not return ``count`` torques."""
        try:
            found = self(*inputs)
            torques = found[0] if isinstance(found, tuple) else found
            if torques.numel() == count:
                return found
            reason = f"returns {torques.numel() / count:g} numbers for one joint"
        except (RuntimeError, AttributeError) as error:
            reason = "rejects its inputs: " + [line for line in str(error).splitlines() if line.strip()][-1]
        expected = "a network from the values of one joint to its torque"
        raise ConfigError(f"the network {reason}", key=self._key, expected=expected)


def _kinds(block: torch.Graph | torch.Block) -> Iterator[str]:
    for node in block.nodes():
        yield node.kind()
        for inner in node.blocks():
            yield from _kinds(inner)


class ActuatorNet(DCMotor):
    """An actuator whose neural network computes torques; the motor's torque-speed line limits these torques.

    Args:
        network_file: the TorchScript file, below an asset folder.
    """

    network: Network

    def __init__(
        self,
        joint_names_expr: Names,
        network_file: PathBelow,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        saturation_effort: Positive | Mapping[str, Positive],
        armature: PerJoint | None = None,
        delay: Delay | None = None,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        limits = (effort_limit, velocity_limit, saturation_effort)
        super().__init__(joint_names_expr, math.nan, math.nan, *limits, armature, delay, friction, viscous_friction)
        self._file = network_file

    def read_files(self, folder: Path, key: str, device: torch.device) -> None:
        file, key = folder / NETWORKS / self._file, f"{key}.network_file"
        # A foreign file can make torch enumerate or compute without end, so try the network in a child process first.
        trial = (sha256(file), pickle.dumps(self))
        if trial not in _TRIED:
            call_limited(self.load, file, key, torch.device("cpu"), key=key, seconds=20, gib=4)
            _TRIED.add(trial)
        self.load(file, key, device)

    def load(self, file: Path, key: str, device: torch.device) -> None:
        """Load the network from a file, and run it once; raise ConfigError if it cannot be used."""
        self.network = Network(file, key, device)

    def _motion(self, targets: JointTargets, data: ArticulationData) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the position errors, rad, and the speeds, rad/s, of the actuator group's joints, both (N, k)."""
        ids = self.joint_ids
        return targets.pos[:, ids] - data.joint_pos[:, ids], data.joint_vel[:, ids]


class ActuatorNetMLP(ActuatorNet):
    """A perceptron that maps joint position errors and speeds of past physics steps to torques (Hwangbo et al., 2019).

    The network maps (rows, 2 len(input_idx)), one row per joint, to one number per row. Errors and speeds from before
    the start of an episode are 0. Velocity targets and feed-forward efforts have no effect.

    Args:
        pos_scale: factor on position errors.
        vel_scale: factor on speeds.
        torque_scale: factor on the network's output, N·m.
        input_order: errors before speeds, or speeds before errors.
        input_idx: ages of the network's inputs in physics steps; 0 is the present step, 1 the previous step.
    """

    def __init__(
        self,
        joint_names_expr: Names,
        network_file: PathBelow,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        saturation_effort: Positive | Mapping[str, Positive],
        pos_scale: float,
        vel_scale: float,
        torque_scale: float,
        input_order: Literal["pos_vel", "vel_pos"],
        input_idx: Annotated[Sequence[Natural], NotEmpty()],
        armature: PerJoint | None = None,
        delay: Delay | None = None,
        friction: PerJoint | None = None,
        viscous_friction: PerJoint | None = None,
    ) -> None:
        limits = (effort_limit, velocity_limit, saturation_effort)
        super().__init__(joint_names_expr, network_file, *limits, armature, delay, friction, viscous_friction)
        self._scales = (pos_scale, vel_scale, torque_scale)
        self._swapped = input_order == "vel_pos"
        self._input_idx = list(input_idx)

    def load(self, file: Path, key: str, device: torch.device) -> None:
        super().load(file, key, device)
        self.network.tried(torch.zeros(2, 2 * len(self._input_idx), device=device), count=2)

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        super().connect(num_envs, dt, stream)
        device = self.joint_ids.device
        self._steps = torch.tensor(self._input_idx, device=device)
        shape = (num_envs, max(self._input_idx) + 1, 2, len(self.joint_names))
        self._past = self.buffer("_past", torch.zeros(shape, device=device), fill=0.0)

    def _torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        error, speed = self._motion(targets, data)
        now = torch.stack((error, speed), dim=1).unsqueeze(1)
        self._past.copy_(torch.cat((now, self._past[:, :-1]), dim=1))
        seen = self._past[:, self._steps].permute(0, 3, 2, 1)
        pos, vel = seen[:, :, 0] * self._scales[0], seen[:, :, 1] * self._scales[1]
        inputs = torch.cat((vel, pos) if self._swapped else (pos, vel), dim=2)
        found: torch.Tensor = self.network(inputs.flatten(0, 1)).view_as(error) * self._scales[2]
        return found


class ActuatorNetLSTM(ActuatorNet):
    """An LSTM that computes torques from the present joint position errors and speeds (Rudin et al., 2022).

    An LSTM ``lstm`` with ``batch_first=True`` maps (rows, 1, 2), one row per joint, and a hidden state, at first 0, to
    torques, N·m, and its new state. Velocity targets and feed-forward efforts have no effect.

    The torque limit is that at the joint's present speed. Isaac Lab 2.3.2 always uses the limit of a motor at rest.
    """

    def load(self, file: Path, key: str, device: torch.device) -> None:
        super().load(file, key, device)
        layers = [value for name, value in self.network.weights().items() if name.startswith("lstm.weight_hh_l")]
        if not layers:
            expected = "a batch-first LSTM whose memory is an input and an output"
            raise ConfigError("the network contains no LSTM named 'lstm'", key=key, expected=expected)
        self._layers, self._width = len(layers), int(layers[0].shape[1])
        few = torch.zeros(2, self._layers, 2, self._width, device=device)
        self.network.tried(torch.zeros(2, 1, 2, device=device), (few[0], few[1]), count=2)

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        super().connect(num_envs, dt, stream)
        device, count = self.joint_ids.device, len(self.joint_names)
        self._rows = (self._layers, num_envs, count, self._width)
        hidden = torch.zeros(self._layers, num_envs * count, self._width, device=device)
        self._hidden = self.buffer("_hidden", hidden)
        self._cell = self.buffer("_cell", torch.zeros_like(hidden))

    def reset(self, env_ids: torch.Tensor) -> None:
        for memory in (self._hidden, self._cell):
            fill_rows(memory.view(self._rows).transpose(0, 1), env_ids, 0.0)

    def _torque(self, targets: JointTargets, data: ArticulationData) -> torch.Tensor:
        error, speed = self._motion(targets, data)
        inputs = torch.stack((error.flatten(), speed.flatten()), dim=1).unsqueeze(1)
        torque, (hidden, cell) = self.network(inputs, (self._hidden, self._cell))
        self._hidden.copy_(hidden)
        self._cell.copy_(cell)
        found: torch.Tensor = torque.view_as(error)
        return found
