"""Compute the matrix products of the policy update in bfloat16 on CPUs that support it, or in TF32 on GPUs.

Weights, biases, derivatives of activations, losses, sums of gradients, and the optimizer stay float32. The factors of
matrix products, and the values between two layers, are rounded to 8 significant bits. Sources: mixed precision,
Micikevicius and others 2018; bfloat16, Kalamkar and others 2019. oneDNN sums products in float32. Rollouts, evaluation,
and export always use float32. Isaac Lab trains with TF32, a format with a mantissa of 10 bits.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.machine import is_intel
from wheelleg_exp.rl.options import Learning, Matmul

if TYPE_CHECKING:
    from rsl_rl.modules import MLP

KEY = "agent.matmul"
# A layer of at least ``FEWEST_WEIGHTS`` weights is faster in bfloat16 than in float32, despite the conversions.
FEWEST_WEIGHTS = 4096
_BLOCK = 1 << 17  # numbers per block
# With a value in ``_ANY``, the environment variable ONEDNN_MAX_CPU_ISA allows AMX instructions.
_ANY = ("", "ALL", "DEFAULT")
# With a value in ``_WITH_VECTORS``, ONEDNN_MAX_CPU_ISA allows bf16 vector instructions.
_WITH_VECTORS = (*_ANY, "AVX512_CORE_BF16", "AVX10_1_512", "AVX512_CORE_FP16")
# Test several thread counts: 1 and 16 threads can give equal products while 2 threads give another product.
_COUNTS = (1, 2, 3, 4, 8, 16)


def chosen_matmul(agent: Learning) -> Matmul:
    """Return the precision that ``agent.matmul`` selects; raise ConfigError if the device does not support it.

    ``auto`` selects by the type of hardware, not by a measurement, so that restarts of a run use the same precision.
    """
    wanted, on_gpu = agent.matmul, agent.device.startswith("cuda")
    why_not = "agent.torch_compile_mode compiles the networks" if agent.torch_compile_mode is not None else ""
    if not agent.device.startswith("cpu"):
        why_not = f"agent.device is {agent.device}"
    if wanted == "bfloat16" and why_not:
        raise ConfigError(f"bfloat16 is for eager mode on CPUs, but {why_not}", key=KEY, expected="auto or float32")
    if wanted == "tf32" and not on_gpu:
        message = f"tf32 is for GPUs, and agent.device is {agent.device}"
        raise ConfigError(message, key=KEY, expected="auto or float32")
    if wanted != "auto" or on_gpu:
        return "tf32" if wanted == "auto" else wanted
    return "bfloat16" if not why_not and has_units() else "float32"


def has_units() -> bool:
    """Return whether oneDNN can multiply bfloat16 faster than float32 on this CPU, with the instructions it may use.

    AMX and the bf16 vector instructions of AMD's CPUs multiply bfloat16 faster than float32. The bf16 vector
    instructions of Intel's CPUs multiply more slowly than float32 instructions.
    """
    if not torch.backends.mkldnn.is_available():
        return False
    most = os.environ.get("ONEDNN_MAX_CPU_ISA", os.environ.get("DNNL_MAX_CPU_ISA", "")).upper()
    tiles = most in _ANY or "AMX" in most
    if tiles and torch.cpu._is_amx_tile_supported():
        return True
    vectors = tiles or most in _WITH_VECTORS or most.startswith("AVX10")
    return vectors and torch.cpu._is_avx512_bf16_supported() and not is_intel()


def products_depend_on_threads(networks: Iterable[nn.Module], rows: int, threads: int) -> bool:
    """Return whether a network layer's matrix products with a batch of ``rows`` depend on the number of threads.

    With AMX, oneDNN may split a sum among threads, which changes the rounding; products of random matrices show this.
    """
    before, draw = torch.get_num_threads(), torch.Generator().manual_seed(0)
    layers = [layer for perceptron in _perceptrons(networks) for layer in perceptron]
    large = [layer for layer in layers if isinstance(layer, nn.Linear) and _is_large(layer)]
    try:
        for size in {(layer.in_features, layer.out_features) for layer in large}:
            x, grad = (torch.randn(min(rows, 8192), width, generator=draw).bfloat16() for width in size)
            factors = torch.randn(size[::-1], generator=draw).bfloat16()
            alone: list[torch.Tensor] = []
            for count in sorted({*_COUNTS, threads}):
                torch.set_num_threads(count)
                found = [_multiply(grad.t(), x), _multiply(x, factors.t()), _multiply(grad, factors)]
                alone = alone or found
                if not all(map(torch.equal, found, alone)):
                    return True
    finally:
        torch.set_num_threads(before)
    return False


def _perceptrons(networks: Iterable[nn.Module]) -> list[MLP]:
    from rsl_rl.modules import MLP

    found = [part for net in networks for part in net.modules() if isinstance(part, MLP)]
    return [part for part in found if type(part).forward is MLP.forward]


@contextmanager
def bfloat16_products(networks: Iterable[nn.Module]) -> Iterator[None]:
    """Make the MLPs ``networks`` multiply in bfloat16 in a ``with`` block, in the forward and the backward pass."""
    perceptrons = _perceptrons(networks)
    for perceptron in perceptrons:
        perceptron.forward = _forward_of(list(perceptron))
    try:
        yield
    finally:
        for perceptron in perceptrons:
            del perceptron.forward


@contextmanager
def tf32_products() -> Iterator[None]:
    """Make a GPU multiply float32 matrices in TF32 inside a ``with`` block."""
    before = torch.backends.cuda.matmul.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = True
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32 = before


def _forward_of(layers: list[nn.Module]) -> Callable[[torch.Tensor], torch.Tensor]:
    def forward(x: torch.Tensor) -> torch.Tensor:
        rest = iter(range(len(layers)))
        for index in rest:
            layer = layers[index]
            if isinstance(layer, nn.Linear) and _is_large(layer):
                following = layers[index + 1] if index + 1 < len(layers) else None
                elu = type(following) is nn.ELU and following.alpha == 1.0
                x = linear(x, layer.weight, layer.bias, elu=elu)
                if elu:
                    next(rest)
            else:
                x = layer(x.float())
        return x.float()

    return forward


def _is_large(layer: nn.Linear) -> bool:
    return type(layer) is nn.Linear and layer.bias is not None and layer.weight.numel() >= FEWEST_WEIGHTS


def linear(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, *, elu: bool = False) -> torch.Tensor:
    """Return the output (..., O) of a linear layer, computed from inputs and weights that are rounded to bfloat16.

    ``x`` (..., I) is float32 or bfloat16; ``bias`` (O,) is added in float32. With ``elu`` (alpha 1), return bfloat16.
    """
    apply: Callable[..., torch.Tensor] = _Linear.apply
    return apply(x.reshape(-1, x.shape[-1]), weight, bias, elu).reshape(*x.shape[:-1], -1)


class _Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, elu: bool) -> torch.Tensor:
        low, factors = x.bfloat16(), weight.bfloat16()
        y = _multiply(low, factors.t())
        if elu:
            # Add a layer's bias and apply ELU in float32, in place, in blocks of rows that fit into the CPU cache.
            # torch's ELU is not used, because its result, unlike that of `exp`, depends on the number of threads.
            for rows in torch.split(y, max(1, _BLOCK // y.shape[1])):
                part = rows + bias
                rows.copy_(torch.maximum(part, part.clamp(max=0).exp_().sub_(1), out=part))
        else:
            y = y + bias
        ctx.save_for_backward(low, factors, *([y] if elu else []))
        ctx.dtype = x.dtype
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        low, factors, *outputs = ctx.saved_tensors
        grad = grad.bfloat16()
        for y in outputs:
            grad = torch.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, y)
        of_x = _multiply(grad, factors).to(ctx.dtype) if ctx.needs_input_grad[0] else None
        return of_x, _multiply(grad.t(), low).float(), grad.sum(0).float(), None


def _multiply(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.mm(a, b)
