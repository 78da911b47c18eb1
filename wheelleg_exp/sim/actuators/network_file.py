"""Networks of learned drives, read from TorchScript files that anybody may have made.

Such a file holds numbers and a program in TorchScript's own language. To load and run one runs no Python, but
operations of that language write files, and some may run while it is loaded. So it is looked through before: what runs
at loading is refused, and so is every operation that perceptrons and recurrent networks do not need.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.files import read_bytes
from wheelleg_exp.reading import require_bounded
from wheelleg_exp.state import Kept

_LANGUAGE = frozenset(
    """Constant GetAttr If ListConstruct ListUnpack Loop NumToTensor RaiseException TupleConstruct TupleIndex
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


class Network(Kept):
    """A network of a TorchScript file; its numbers do not change.

    Args:
        file: where it lies.
        key: the config key that names it, for messages.
        device: where it runs.

    Raises:
        ConfigError: it is no TorchScript file, or does what a network need not do.
    """

    def __init__(self, file: Path, key: str, device: torch.device | None) -> None:
        self._key = key
        data = read_bytes(file)
        try:
            self._require_harmless_loading(data)
            module = torch.jit.load(io.BytesIO(data), map_location=device)
            graph = module.eval().inlined_graph
        except (RuntimeError, AttributeError, ValueError, BadZipFile) as error:
            reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            raise self._refused(f"'{file.name}' is no TorchScript network: {reason}") from error
        for kind in _kinds(graph):
            space, _, name = kind.partition("::")
            known = {"prim": _LANGUAGE, "aten": _OPERATIONS}.get(space, frozenset())
            if name not in known and name.removesuffix("_") not in known:
                raise self._refused(f"'{file.name}' runs '{kind}', which is not among what networks are made of")
        self._module = module

    def _refused(self, message: str) -> ConfigError:
        return ConfigError(message, key=self._key, expected="a network of torch.nn's layers, saved by torch.jit.save")

    def _require_harmless_loading(self, data: bytes) -> None:
        require_bounded(ZipFile(io.BytesIO(data)))
        reader = torch._C.PyTorchFileReader(io.BytesIO(data))
        if any(_RUNS_AT_LOADING in reader.get_record(name) for name in reader.get_all_records() if "code/" in name):
            raise self._refused(f"holds a '{_RUNS_AT_LOADING.decode()}', which would run while it is loaded")

    def weights(self) -> dict[str, torch.Tensor]:
        """Return its numbers by name."""
        return dict(self._module.state_dict())

    def __call__(self, *inputs: Any) -> Any:
        """Return what it makes of its inputs: always by the same operations, so that runs repeat to the bit."""
        with torch.no_grad(), torch.jit.optimized_execution(False):
            return self._module.forward(*inputs)

    def tried(self, *inputs: Any, count: int) -> Any:
        """Return what it makes of its inputs; ConfigError unless it takes them and gives ``count`` torques (first)."""
        try:
            found = self(*inputs)
            torques = found[0] if isinstance(found, tuple) else found
            if torques.numel() == count:
                return found
            reason = f"gives {torques.numel() / count:g} numbers a joint"
        except (RuntimeError, AttributeError) as error:
            reason = "does not take its inputs: " + [line for line in str(error).splitlines() if line.strip()][-1]
        raise ConfigError(
            f"the network {reason}", key=self._key, expected="the numbers of one joint in, its torque out"
        )


def _kinds(block: Any) -> Iterator[str]:
    """Yield the kind of each operation of a graph."""
    for node in block.nodes():
        yield node.kind()
        for inner in node.blocks():
            yield from _kinds(inner)
