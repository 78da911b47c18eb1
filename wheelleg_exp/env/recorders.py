"""What records work on a device and repeats it: CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class Recorder(Protocol):
    """What records work and repeats it: a CUDA graph, or a stand-in."""

    def record(self, work: Callable[[], None]) -> None:
        """Do the work and record it."""

    def replay(self) -> None:
        """Do the recorded work again, on the same memory."""


class CudaGraph:
    """A CUDA graph of torch's, in which random streams go on from replay to replay.

    Args:
        generators: the random streams that the work may draw from.
        pool: memory that graphs share which are never replayed at the same time.
    """

    def __init__(self, generators: Sequence[torch.Generator], pool: Any = None) -> None:
        self._generators, self._pool = generators, pool
        self._graph = self._made()

    def _made(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            # Of the class itself, with the same state: torch takes no subclass here.
            graph.register_generator_state(generator.graphsafe_get_state())
        return graph

    def record(self, work: Callable[[], None]) -> None:
        """Do the work and record it; it runs at the first replay."""
        torch.cuda.synchronize()
        stream, failed = torch.cuda.current_stream(), []
        try:
            with torch.cuda.graph(self._graph, pool=self._pool, capture_error_mode="thread_local"):
                try:
                    work()
                except Exception as error:
                    failed.append(error)
                    raise
        except Exception as error:
            torch.cuda.set_stream(stream)  # a capture that fails at its end leaves its own
            # Random streams wait for the end of a capture, and would not be drawn from.
            with torch.cuda.graph(self._made(), capture_error_mode="thread_local"):
                torch.zeros(1, device="cuda")
            told = (failed or [error])[0]  # the work's own, which names the term
            raise told from told.__cause__

    def replay(self) -> None:
        """Do the recorded work again."""
        self._graph.replay()


class Touched(TorchDispatchMode):
    """Notes the memory that torch's operations read and write."""

    def __init__(self) -> None:
        super().__init__()
        self._memory: set[int] = set()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Do an operation, and note its tensors."""
        del types
        result = operation(*args, **(kwargs or {}))
        self.note((args, kwargs, result))
        return result

    def note(self, tree: Any) -> None:
        """Note the tensors of a nested structure."""
        for leaf in tree_leaves(tree):
            if isinstance(leaf, torch.Tensor):
                self._memory.add(leaf.untyped_storage().data_ptr())

    def has(self, tensor: torch.Tensor) -> bool:
        """Return whether a tensor's memory is among it."""
        return tensor.untyped_storage().data_ptr() in self._memory
