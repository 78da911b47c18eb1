"""A part of the step compiled into few kernels, and these captured as one CUDA graph.

A part is hundreds of small operations, and a GPU takes some microseconds for each however small it is. Inductor makes
one kernel of many. What it makes is held against the operations' own numbers before it is used.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from operator import getitem
from typing import Any

import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._pytree import tree_leaves, tree_map_only

from wheelleg_exp.env.recorders import CudaGraph, Recorder
from wheelleg_exp.env.tape import Operation, Piece, Tape, Value, whole
from wheelleg_exp.paths import cache_dir

_SETTINGS = {
    "unroll_reductions_threshold": 33,  # sums over components and joints become part of the kernel around them
    "triton.cudagraphs": False,  # captured with all else
}
_LARGEST_SUM = 32  # of products of matrices that are written out
_RTOL, _ATOL, _MOST_FLIPPED = 1e-3, 1e-4, 1e-3  # of a tensor's largest number; share of flags that may be others
_ATEN: Any = torch.ops.aten
_PRODUCTS = (_ATEN.mm.default, _ATEN.bmm.default, _ATEN.matmul.default)
_COPIES = (_ATEN.clone.default, _ATEN.copy_.default)


class Fused:
    """Records work as few kernels in a CUDA graph.

    Args:
        generators: the random streams that the work may draw from.
        graph: makes what captures the kernels.
    """

    def __init__(
        self,
        generators: Sequence[torch.Generator],
        graph: Callable[[Sequence[torch.Generator]], Recorder] = CudaGraph,
    ) -> None:
        self._generators, self._graph = generators, graph(generators)
        self._is_new = True
        self.pieces: list[Callable[[], None]] = []

    def record(self, work: Callable[[], None]) -> None:
        """Do the work and record it; the first replay does nothing."""
        tape = Tape()
        states = [generator.get_state() for generator in self._generators]
        try:
            tape.record(work)
            with torch.inference_mode(False), torch.no_grad():
                self.pieces = _compiled(tape)
                self._graph.record(self._run)
        except Exception:  # nothing was done
            tape.undo()
            for generator, state in zip(self._generators, states, strict=True):
                generator.set_state(state)
            raise

    def _run(self) -> None:
        for piece in self.pieces:
            piece()

    def replay(self) -> None:
        """Do the recorded work again; the first time it has been done."""
        if not self._is_new:
            self._graph.replay()
        self._is_new = False


def _compiled(tape: Tape) -> list[Callable[[], None]]:
    """Return what does the work of a tape again; piece by piece as it was where compiling it fails."""
    pieces = tape.pieces()
    plain = [_Alone(piece.operations[0]) if piece.alone else _Plain(piece) for piece in pieces]
    try:
        found = [piece if isinstance(piece, _Alone) else piece.compiled() for piece in plain]
        _require_same(tape, pieces, found)
    except Exception as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        warnings.warn(f"a part of the step is not fused, but a plain graph: {reason}", stacklevel=2)
        return list(plain)
    return list(found)


class _Alone:
    """An operation that is done as it is, into the memory that it was done into first."""

    def __init__(self, operation: Operation) -> None:
        self.is_drawn = isinstance(operation.call, torch._ops.OpOverload)
        self._call = operation.call
        self._args, self._kwargs = tree_map_only(Value, Value.tensor, (operation.args, operation.kwargs))
        self._results = [value.tensor() for value in operation.results]

    def __call__(self) -> None:
        again = [
            leaf for leaf in tree_leaves(self._call(*self._args, **self._kwargs)) if isinstance(leaf, torch.Tensor)
        ]
        for result, value in zip(self._results, again, strict=False):
            result.copy_(value)


class _Plain:
    """The operations of a piece as a graph of torch.fx, whose inputs are the memory that it reads and writes."""

    def __init__(self, piece: Piece) -> None:
        self._graph = torch.fx.Graph()
        self._nodes: dict[int, torch.fx.Node] = {}
        outside: dict[tuple[Any, ...], Value] = {}
        inside = {id(value) for operation in piece.operations for value in operation.results}
        for operation in piece.operations:
            for value in operation.read:
                if id(value) not in inside:
                    outside.setdefault(value.key, value)
        inputs = [*outside.values(), *piece.kept]
        given = {value.key: self._graph.placeholder(f"given{index}") for index, value in enumerate(inputs)}
        for operation in piece.operations:
            self._nodes |= {id(v): given[v.key] for v in operation.read if id(v) not in inside}
            self._add(operation)
        for value in piece.kept:
            self._graph.call_function(_ATEN.copy_.default, (given[value.key], self._nodes[id(value)]))
        self._graph.output(())
        self._inputs = inputs
        self._tensors = [value.tensor() for value in inputs]
        self._module = torch.fx.GraphModule({}, self._graph)

    def _add(self, operation: Operation) -> None:
        args, kwargs = tree_map_only(Value, lambda value: self._nodes[id(value)], (operation.args, operation.kwargs))
        if operation.call in _COPIES:
            args = tree_map_only(torch.fx.Node, self._kept_apart, args)
            if operation.call is _ATEN.copy_.default:
                args = (self._nodes[id(operation.args[0])], *args[1:])
        if operation.call in _PRODUCTS and _is_small(*operation.args):
            node = self._product(*args)
        else:
            node = self._graph.call_function(operation.call, args, kwargs)
        for index, value in enumerate(operation.results):
            item = self._graph.call_function(getitem, (node, index)) if operation.is_several else node
            self._nodes[id(value)] = item

    def _kept_apart(self, node: torch.fx.Node) -> torch.fx.Node:
        """Return the same numbers by an operation that Inductor does not leave out.

        It takes a copy of an input for the input itself, even where that is written before the copy is.
        """
        return self._graph.call_function(_ATEN.maximum.default, (node, node))

    def _product(self, left: Any, right: Any) -> torch.fx.Node:
        """Write a small product of matrices out, which then is part of the kernel around it."""
        call = self._graph.call_function
        wide = call(_ATEN.unsqueeze.default, (left, -1))
        high = call(_ATEN.unsqueeze.default, (right, -3))
        return call(_ATEN.sum.dim_IntList, (call(_ATEN.mul.Tensor, (wide, high)), [-2]))

    def __call__(self) -> None:
        self._module(*self._tensors)

    def compiled(self) -> Callable[[], None]:
        """Return the piece as Inductor compiles it."""
        with FakeTensorMode():
            fakes = [_imagined(value) for value in self._inputs]
        run = _compile(self._module, fakes)
        tensors = self._tensors

        def again() -> None:
            run(*tensors)

        return again


def _compile(module: torch.fx.GraphModule, inputs: Sequence[torch.Tensor]) -> Any:
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(cache_dir() / "inductor"))
    from torch._inductor.compile_fx import compile_fx  # takes a second to import, and reads the variable

    return compile_fx(module, inputs, config_patches=_SETTINGS)


def _is_small(left: Value, right: Value) -> bool:
    return len(left.form[0]) > 1 < len(right.form[0]) and left.form[0][-1] <= _LARGEST_SUM


def _imagined(value: Value) -> torch.Tensor:
    """Return a tensor without memory of a value's form, in a memory of its own."""
    shape, strides, offset = value.form
    length = value.storage.nbytes() // value.dtype.itemsize
    return torch.empty(length, dtype=value.dtype, device=value.storage.device).as_strided(shape, strides, offset)


def _require_same(tape: Tape, pieces: Sequence[Piece], found: Sequence[Callable[[], None]]) -> None:
    """Run compiled pieces from where the tape began; raise RuntimeError unless the same numbers come out.

    What was drawn is there already. All is left as the tape has left it.
    """
    kept = {value.memory: value for piece in pieces for value in piece.kept if not piece.alone}
    values = {memory: value for memory, (value, _) in tape.before.items()} | kept
    wanted = {memory: whole(value).clone() for memory, value in values.items()}
    tape.undo()
    for value in kept.values():
        whole(value).zero_()
    try:
        for piece in found:
            if not (isinstance(piece, _Alone) and piece.is_drawn):
                piece()
        for memory, value in values.items():
            _require_close(whole(value), wanted[memory])
    finally:
        for memory, value in values.items():
            whole(value).copy_(wanted[memory])


def _require_close(found: torch.Tensor, wanted: torch.Tensor) -> None:
    if not wanted.numel():
        return
    if wanted.is_floating_point():
        finite = wanted[wanted.isfinite()]
        size = float(finite.abs().max()) if finite.numel() else 1.0
        if torch.allclose(found, wanted, rtol=_RTOL, atol=_ATOL * size, equal_nan=True):
            return
    elif float((found != wanted).float().mean()) <= _MOST_FLIPPED:
        return
    raise RuntimeError(f"compiled, a tensor of {wanted.numel()} numbers comes out otherwise")
