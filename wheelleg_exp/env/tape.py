"""The operations of torch that a part of the step does, cut into pieces that can be compiled.

An operation that draws random numbers, or that touches several devices, stays by itself, and so does work that is none
of torch's, such as launches of Warp. In a piece no two tensors from outside share memory that the piece writes, because
a compiler takes what it is handed for different memory.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from wheelleg_exp.sim.warp.launches import listening

_EMPTY = frozenset(("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"))


@dataclass(eq=False)
class Value:
    """A tensor of the recorded run, by its memory: the tensor itself may be gone.

    Attributes:
        storage: its memory.
        form: shape, strides and offset.
        dtype: its type of numbers.
    """

    storage: torch.UntypedStorage
    form: tuple[tuple[int, ...], tuple[int, ...], int]
    dtype: torch.dtype

    @staticmethod
    def of(tensor: torch.Tensor) -> Value:
        """Return the value of a tensor."""
        form = tuple(tensor.shape), tuple(tensor.stride()), int(tensor.storage_offset())
        return Value(tensor.untyped_storage(), form, tensor.dtype)

    @property
    def memory(self) -> int:
        """Where its memory begins."""
        return self.storage.data_ptr()

    @property
    def key(self) -> tuple[Any, ...]:
        """The same for tensors that are the same numbers in the same memory."""
        return self.memory, self.form, self.dtype

    def tensor(self) -> torch.Tensor:
        """Return a tensor of this memory."""
        shape, strides, offset = self.form
        with torch.inference_mode(False):
            empty = torch.empty(0, dtype=self.dtype, device=self.storage.device)
            return empty.set_(self.storage, offset, shape, strides)

    def may_meet(self, other: Value) -> bool:
        """Return whether its memory and another's may overlap."""
        if 0 in self.form[0] or 0 in other.form[0]:
            return False
        (ours, our_end, our_row), (theirs, their_end, their_row) = self._extent(), other._extent()
        if ours >= their_end or theirs >= our_end:
            return False
        if our_row != their_row or not our_row:
            return True
        start = min(ours, theirs)  # columns of the same rows
        our_columns, their_columns = ((value - start) % our_row for value in (ours, theirs))
        our_stop, their_stop = our_columns + self._extent(1)[1] - ours, their_columns + other._extent(1)[1] - theirs
        return max(our_stop, their_stop) > our_row or (our_columns < their_stop and their_columns < our_stop)

    def _extent(self, first: int = 0) -> tuple[int, int, int]:
        """Return where it, or its first row, begins and ends, and how far its rows are apart, in bytes."""
        shape, strides, offset = self.form
        size = self.dtype.itemsize
        last = sum((length - 1) * stride for length, stride in zip(shape[first:], strides[first:], strict=True))
        start = self.memory + size * offset
        return start, start + size * (last + 1), size * strides[0] if len(shape) > 1 and shape[0] > 1 else 0


@dataclass(eq=False)
class Operation:
    """One operation of torch, or work that is none of torch's.

    Attributes:
        call: does it.
        args: with values in the place of tensors.
        kwargs: with values in the place of tensors.
        results: what it returned, without what it was handed.
        written: the values that it writes.
        alone: whether it is in no piece.
        is_several: whether it returned a sequence.
    """

    call: Callable[..., Any]
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    results: list[Value]
    written: list[Value]
    alone: bool
    is_several: bool = False

    @property
    def read(self) -> list[Value]:
        """The values that it is handed."""
        return [leaf for leaf in tree_leaves((self.args, self.kwargs)) if isinstance(leaf, Value)]


@dataclass
class Piece:
    """Operations in their order that are compiled together, or one that is by itself.

    Attributes:
        operations: in their order.
        alone: whether it is one that is not compiled.
        kept: what is made in it and outlives it.
    """

    operations: list[Operation]
    alone: bool
    kept: list[Value] = field(default_factory=list)


class Tape(TorchDispatchMode):
    """Notes what is done while it is entered.

    Attributes:
        operations: in their order.
        before: what the memory held, as bytes, that was there before and was written, by where it begins.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations: list[Operation] = []
        self.before: dict[int, tuple[Value, torch.Tensor]] = {}
        self._values: dict[int, tuple[torch.Tensor, Value]] = {}
        self._made: dict[int, Value] = {}
        self._alive: set[int] = set()

    def record(self, work: Callable[[], None]) -> None:
        """Do the work and note it; RuntimeError where the host waits for a number."""
        with listening(self._note_launch), self:
            work()
        results = [(weakref.ref(tensor), value) for tensor, value in self._values.values()]
        self._values.clear()
        self._alive = {value.memory for known, value in results if known() is not None}

    def pieces(self) -> list[Piece]:
        """Return what was noted, cut into pieces."""
        drawn = [operation for operation in self.operations if operation.alone and not operation.read]
        drawn = [operation for operation in drawn if operation.results]  # random numbers wait for nothing
        found = [Piece([operation], alone=True) for operation in drawn]
        found += _cut(operation for operation in self.operations if operation not in drawn)
        needed = set(self._alive)
        for piece in reversed(found):
            made = {value.memory: value for operation in piece.operations for value in _owners(operation)}
            piece.kept = [value for memory, value in made.items() if memory in needed]
            needed.update(value.memory for operation in piece.operations for value in operation.read)
        return found

    def undo(self) -> None:
        """Let all memory that was there before hold what it held."""
        for value, held in self.before.values():
            whole(value).copy_(held)

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do an operation, and note it."""
        del types
        kwargs = kwargs or {}
        if _waits(operation, args):
            raise RuntimeError(f"{operation} waits for the device")
        written = [self._value(tensor) for tensor in _written(operation, args, kwargs)]
        for value in written:
            self._keep_before(value)
        values, named = tree_map_only(torch.Tensor, self._value, (args, kwargs))
        result = operation(*args, **kwargs)
        handed = {id(leaf) for leaf in tree_leaves((args, kwargs))}
        if operation.__name__.split(".")[0] in _EMPTY:
            return result
        alone = _is_alone(operation, args, kwargs)
        results = []
        for tensor in tree_leaves(result):
            if isinstance(tensor, torch.Tensor) and id(tensor) not in handed:
                results.append(self._value(tensor))
        note = Operation(operation, values, named, results, written, alone, isinstance(result, (tuple, list)))
        self.operations.append(note)
        if not alone:
            self._made.update((value.memory, value) for value in _owners(note))
        return result

    def _note_launch(self, again: Callable[[], None], reads: Sequence[torch.Tensor]) -> None:
        self.operations.append(Operation(_ignoring(again), tuple(map(self._value, reads)), {}, [], [], True))

    def _value(self, tensor: torch.Tensor) -> Value:
        if id(tensor) not in self._values:
            self._values[id(tensor)] = tensor, Value.of(tensor)
        return self._values[id(tensor)][1]

    def _keep_before(self, value: Value) -> None:
        if value.memory not in self._made and value.memory not in self.before:
            self.before[value.memory] = value, whole(value).clone()


def whole(value: Value) -> torch.Tensor:
    """Return all of a value's memory, as a tensor of one dimension."""
    length = value.storage.nbytes() // value.dtype.itemsize
    return Value(value.storage, ((length,), (1,), 0), value.dtype).tensor()


def _ignoring(call: Callable[[], None]) -> Callable[..., None]:
    return lambda *_: call()


def _owners(operation: Operation) -> list[Value]:
    """Return the results that are in memory of their own."""
    taken = {value.memory for value in operation.read}
    return [value for value in operation.results if value.memory not in taken]


def _written(operation: Any, args: Any, kwargs: Any) -> Iterator[torch.Tensor]:
    for index, argument in enumerate(operation._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            given = args[index] if index < len(args) else kwargs.get(argument.name)
            yield from (leaf for leaf in tree_leaves(given) if isinstance(leaf, torch.Tensor))


def _waits(operation: Any, args: Any) -> bool:
    """Return whether an operation's result has a form that depends on numbers, or is a number of the host's."""
    if operation is torch.ops.aten.index.Tensor:
        return any(index is not None and not index.dtype.is_signed for index in args[1])  # masks
    return bool({torch.Tag.data_dependent_output, torch.Tag.dynamic_output_shape} & set(operation.tags))


def _is_alone(operation: Any, args: Any, kwargs: Any) -> bool:
    leaves = tree_leaves((args, kwargs))
    places = {leaf.device for leaf in leaves if isinstance(leaf, torch.Tensor) and (leaf.ndim or leaf.is_cuda)}
    return torch.Tag.nondeterministic_seeded in operation.tags or len(places) > 1


def _cut(operations: Iterable[Operation]) -> Iterator[Piece]:
    """Yield pieces in which nothing from outside that is written may overlap anything else from outside."""
    piece = _Open()
    for operation in operations:
        if operation.alone or not piece.takes(operation):
            if piece.operations:
                yield Piece(piece.operations, alone=False)
            piece = _Open()
        if operation.alone:
            yield Piece([operation], alone=True)
        else:
            piece.add(operation)
    if piece.operations:
        yield Piece(piece.operations, alone=False)


class _Open:
    """A piece that is being filled."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self._inside: dict[int, Value] = {}  # values made here, views of what is from outside included: from what
        self._outside: dict[tuple[Any, ...], Value] = {}
        self._written: list[tuple[Value, Value]] = []  # and what they are a view of

    def takes(self, operation: Operation) -> bool:
        """Return whether an operation may be done in this piece."""
        new = [value for value in operation.read if id(value) not in self._inside]
        writes = [(value, self._inside.get(id(value), value)) for value in operation.written]
        written = [*self._written, *writes]
        outside = [*self._outside.values(), *new]
        return not any(root.key != other.key and value.may_meet(other) for value, root in written for other in outside)

    def add(self, operation: Operation) -> None:
        """Take an operation."""
        self.operations.append(operation)
        for value in operation.read:
            if id(value) not in self._inside:
                self._inside[id(value)] = self._outside.setdefault(value.key, value)
        self._written += [(value, self._inside[id(value)]) for value in operation.written]
        for value in operation.results:
            of = next((read for read in operation.read if read.memory == value.memory), None)
            self._inside[id(value)] = value if of is None else self._inside[id(of)]
