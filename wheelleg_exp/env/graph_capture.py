"""Capture the parts of an environment's step as CUDA graphs: one launch instead of hundreds of small kernels.

The decorator ``captured_part`` marks a method of the environment as a part of the environment's step. Without CUDA
graphs, a method decorated with ``captured_part`` runs as Python code. ``GraphCapture`` runs a decorated method a few
times, records the method as a CUDA graph, and then replays this graph.

A CUDA graph repeats kernels on fixed memory and does not run Python. A replay skips Python assignments, so
``GraphCapture`` must know all attributes that the recorded method reads and writes. The contract for the objects that a
captured method uses (terms, managers, robot, sensors) is:

- **Buffers** are attributes that hold a tensor, also in dictionaries and lists. A captured method may change an
  attribute's tensor in place, or replace it by a new tensor of the same shape.
- **Settings** are attributes that hold a number, a text, None, or a tuple. If a number in an attribute changes,
  ``GraphCapture`` does not replay a graph that was recorded with the old number. ``GraphCapture`` records one CUDA
  graph for each frequent combination of the attributes' numbers and texts.
- A captured method may also change a number or text, if the new value depends only on the old numbers and texts.
- All other values that a captured method changes are undeclared: a number that counts up, a growing list, a deque, a
  tuple of tensors, a module, or a foreign object. A method that changes a counter or a list, or that waits for the GPU,
  runs without a CUDA graph. A warning names the reason.

Each method runs twice as Python code before the method is recorded as a CUDA graph. ``GraphCapture`` finds the
attributes that a method changes by comparing them before and after the second run.
"""

from __future__ import annotations

import functools
import warnings
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar, cast

import torch

from wheelleg_exp.env import captured_values
from wheelleg_exp.env.captured_values import Key, Values, form_of, is_changed
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.state import cloned
from wheelleg_exp.state.object_graph import Slot, is_plain

# After two runs of a method, lazily created tensors exist, and CUDA libraries have allocated their workspaces.
_RUNS_BEFORE_CAPTURE = 2
# Record at most 8 CUDA graphs per method, and 128 for the reset: one per number of reset environments.
_RECORDINGS, _RESET_RECORDINGS = 8, 128
# Count how often each combination of attribute values occurred among a method's last 1024 calls.
_WINDOW = 1024
# Warn when a method's runs as Python code outnumber the replays of its CUDA graphs by 256.
_MANY = 256
_MOST_MISMATCHES = 64

Method = TypeVar("Method", bound=Callable[..., Any])


def captured_part(*, to_caller: bool = False) -> Callable[[Method], Method]:
    """Mark a method of the environment's step that may be captured as a CUDA graph.

    If ``to_caller`` is true, the environment returns the result to its caller, so ``GraphCapture`` copies the result
    out of the CUDA graph's memory. The caller may change attributes of the environment, so ``GraphCapture`` checks for
    changes before the next replay.
    """

    def decorate(method: Method) -> Method:
        @functools.wraps(method)
        def run(env: Any, *args: Any) -> Any:
            if env.graph_capture is None:
                return method(env, *args)
            return env.graph_capture.run(method, args, to_caller=to_caller)

        return cast(Method, run)

    return decorate


def host_part(method: Method) -> Method:
    """Mark a method that always runs as Python code and may change any attribute, for example by calling user code.

    If a method marked by ``host_part`` returns False, ``GraphCapture`` assumes that it has changed no attribute.
    """

    @functools.wraps(method)
    def run(env: Any, *args: Any, **kwargs: Any) -> Any:
        if env.graph_capture is None:
            return method(env, *args, **kwargs)
        values = env.graph_capture.values
        was_checked, values.is_checked = values.is_checked, False
        found = method(env, *args, **kwargs)
        values.is_checked = was_checked and found is False
        return found

    return cast(Method, run)


class Graph(Protocol):
    """Records work and repeats it: a CUDA graph, or a substitute in tests."""

    def record(self, work: Callable[[], None]) -> None:
        """Record the work."""

    def replay(self) -> None:
        """Run the recorded kernels again, on the same memory as during the recording."""


class CudaGraph:
    """A CUDA graph that advances the random streams ``generators`` with each replay."""

    def __init__(self, generators: Sequence[torch.Generator]) -> None:
        self._generators = generators
        self._graph = self._make()

    def _make(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            # CUDA graphs reject subclasses of torch.Generator, so pass the plain generator from graphsafe_get_state.
            graph.register_generator_state(generator.graphsafe_get_state())
        return graph

    def record(self, work: Callable[[], None]) -> None:
        """Record the kernels that the function ``work`` launches, without running them."""
        torch.cuda.synchronize()
        stream, failed = torch.cuda.current_stream(), []
        try:
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                try:
                    work()
                except Exception as error:
                    failed.append(error)
                    raise
        except Exception as error:
            # If a capture fails at its end, its stream remains torch's current stream, so restore the old stream.
            torch.cuda.set_stream(stream)
            # After a failed capture, torch blocks the random generators until the next capture, so capture one kernel.
            with torch.cuda.graph(self._make(), capture_error_mode="thread_local"):
                torch.zeros(1, device="cuda")
            cause = (failed or [error])[0]  # Prefer the error of ``work`` to torch's error, which names no term.
            raise cause from cause.__cause__

    def replay(self) -> None:
        """Launch all kernels of the recorded graph."""
        self._graph.replay()


class GraphCapture:
    """Runs the captured methods of an environment's step as Python code at first, and as CUDA graphs later."""

    def __init__(self, env: Any, make_graph: Callable[[Sequence[torch.Generator]], Graph] = CudaGraph) -> None:
        # Select environments by masks, because masks have a fixed shape, whereas the number of indices varies.
        env.observation_manager.in_masks = True
        # Reset the curriculum and recorder managers without CUDA graphs, because these managers log Python numbers.
        self._reset_later = [env.curriculum_manager, env.recorder_manager]
        env.reset_order = [manager for manager in env.reset_order if manager not in self._reset_later]
        self._env, self._make_graph = env, make_graph
        self.values = Values(env)
        self.parts: dict[str, CapturedPart] = {}

    @property
    def recordings(self) -> int:
        """The number of recorded CUDA graphs of all captured methods."""
        return sum(len(part.recordings) for part in self.parts.values())

    def run(self, method: Callable[..., Any], args: tuple[Any, ...], *, to_caller: bool) -> Any:
        """Run a method of the environment's step, or replay a CUDA graph that was recorded from the method."""
        env = self._env
        name = method.__name__
        if name not in self.parts:
            work, caches, streams = functools.partial(method, env), env.scene.robot.data.invalidate, env.streams.all
            resets = any(isinstance(arg, torch.Tensor) and arg.dtype == torch.long for arg in args)
            options: dict[str, Any] = {"reset_caches": caches, "streams": streams, "is_reset": resets}
            self.parts[name] = CapturedPart(work, self.values, self._make_graph, **options)
        part = self.parts[name]
        found = part(*[arg.to(env.device) if isinstance(arg, torch.Tensor) else arg for arg in args])
        if part.is_reset:
            env.scene.robot.mark_written(args[0])
            for manager in self._reset_later:
                found.update(manager.reset(args[0]))
                self.values.is_checked &= not manager.active_terms
        elif to_caller:
            found = cloned(found)
            self.values.is_checked = False
        return found


@dataclass
class Recording:
    """A recorded CUDA graph of a method, and the attributes that each replay reads and assigns.

    Attributes:
        buffers: the tensor attributes that the method reads or writes, and the CUDA graph's tensor for each attribute.
        shared: ids of tensors whose memory several attributes use; values of other tensors cannot be copied there.
        assigned: the attributes to which the method assigns a value, and the assigned value of each attribute.
        filled: the dictionaries that the method fills, and the entries of each dictionary.
        output: the result of the method, in the memory of the CUDA graph.
    """

    graph: Graph
    inputs: list[Any]
    buffers: list[tuple[Slot, torch.Tensor]]
    assigned: list[tuple[Slot, Any]]
    filled: list[tuple[Slot, dict[Any, Any]]]
    output: Any
    shared: set[int] = field(init=False)
    _places: list[tuple[Any, Any, torch.Tensor]] = field(init=False)
    _containers: list[tuple[Any, Any, Any]] = field(init=False)

    def __post_init__(self) -> None:
        counts = Counter(static.untyped_storage().data_ptr() for _, static in self.buffers)
        self.shared = {id(s) for _, s in self.buffers if counts[s.untyped_storage().data_ptr()] > 1}
        self._find_places()

    def _find_places(self) -> None:
        self._places = [(slot.container, slot.path[-1], static) for slot, static in self.buffers]
        found = {(id(parent), key): (parent, key, c) for slot, _ in self.buffers for parent, key, c in slot.containers}
        self._containers = list(found.values())

    def load(self, args: tuple[Any, ...]) -> list[Slot]:
        """Copy attributes and arguments to the CUDA graph's tensors; return the attributes whose values do not fit."""
        try:
            if not all([parent[key] is container for parent, key, container in self._containers]):
                self._find_places()
            moved = [(place, now) for place in self._places if (now := place[0][place[1]]) is not place[2]]
        except (LookupError, TypeError):
            return [slot for slot, _ in self.buffers if not isinstance(slot.get(), torch.Tensor)]
        if moved:
            wrong = {
                id(static)
                for (_, _, static), now in moved
                if not captured_values.fits(now, static) or id(static) in self.shared
            }
            if wrong:
                return [slot for slot, static in self.buffers if id(static) in wrong]
            captured_values.copy_tensors([(static, now) for (_, _, static), now in moved])
            for (container, key, static), _ in moved:
                container[key] = static
        for static, now in zip(self.inputs, args, strict=True):
            if isinstance(static, torch.Tensor):
                static.copy_(now)
        return []

    def replay(self) -> Any:
        """Replay the CUDA graph, and repeat the method's assignments to attributes, which are not part of the graph."""
        self.graph.replay()
        for slot, content in self.filled:
            whole = slot.get()
            if isinstance(whole, dict):
                whole.clear()
                whole.update(content)
        for slot, value in self.assigned:
            slot.set(value)
        return self.output


class CapturedPart:
    """One method of the environment's step, and the CUDA graphs recorded from it.

    The function ``work`` is the method to capture, which returns tensors. If ``is_reset`` is True, ``work`` resets any
    number of environments and returns a dictionary of logged numbers. All methods captured from one environment share
    the object ``values``, which reads the environment's attributes. The function ``reset_caches`` deletes the robot's
    cached quantities before each run of the method or replay of a CUDA graph. ``streams`` is a function that returns
    all random generators of the environment.
    """

    def __init__(
        self,
        work: Callable[..., Any],
        values: Values,
        make_graph: Callable[[Sequence[torch.Generator]], Graph],
        *,
        reset_caches: Callable[[], None] = lambda: None,
        streams: Callable[[], Sequence[torch.Generator]] = list,
        is_reset: bool = False,
    ) -> None:
        self._work, self._values, self._make_graph = work, values, make_graph
        self._reset_caches, self._streams, self.is_reset = reset_caches, streams, is_reset
        self.recordings: dict[Key, Recording] = {}
        self.fails = False
        self._generation = values.generation
        self._recent, self._counts = deque[Key](), Counter[Key]()
        self._room = _RESET_RECORDINGS if is_reset else _RECORDINGS
        self._checked: set[Key] = set()
        self._drawn: list[torch.Generator] = []
        self._mismatches, self._missed = 0, 0
        self._last: Key = (-1, ())

    def __call__(self, *args: Any) -> Any:
        """Run a method of the environment's step, or replay a CUDA graph that was recorded from the method."""
        self._reset_caches()
        if self.fails:
            return self._run(args)
        state = self._values.key()
        if self._generation != self._values.generation:
            # Delete all CUDA graphs recorded so far, because ``Values.key`` now includes the values of more attributes.
            self._generation = self._values.generation
            self.recordings.clear()
            self._checked.clear()
        key = (*(form_of(arg) for arg in args), *state)
        count = self._count(key)
        recording = self.recordings.get(key)
        if recording is None and not self._is_worth(key, count):
            is_second = not self._checked and len(self._recent) == _RUNS_BEFORE_CAPTURE
            if is_second or (count >= _RUNS_BEFORE_CAPTURE and state not in self._checked):
                return self._run_checked(args, state)
            self._warn_of_changes(key)
            return self._run(args)
        if recording is None:
            recording = self._try_to_record(args)
            if recording is None:
                self._reset_caches()
                return self._run(args)
            if self._generation == self._values.generation:
                # Store the graph only if ``Values.key`` already contained every attribute that the recording changed.
                if len(self.recordings) >= self._room:
                    del self.recordings[self._rarest()]
                self.recordings[key] = recording
        elif unfit := recording.load(args):
            self._drop(key, unfit)
            return self._run(args)
        self._missed -= self._missed > 0
        self._last = key
        output = recording.replay()
        return dict(zip(output[0], output[1].clone().unbind(), strict=True)) if self.is_reset else output

    def _run(self, args: tuple[Any, ...]) -> Any:
        self._values.is_checked = False  # Python code may change any attribute of the environment.
        return self._work(*args)

    def _count(self, key: Key) -> int:
        """Record a call with the attribute values ``key``; return how many of the last 1024 calls had these values."""
        self._recent.append(key)
        self._counts[key] += 1
        if len(self._recent) > _WINDOW:
            oldest = self._recent.popleft()
            self._counts[oldest] -= 1
            if not self._counts[oldest]:
                del self._counts[oldest]
        return self._counts[key]

    def _is_worth(self, key: Key, count: int) -> bool:
        """Return whether the attribute values ``key`` occurred often enough to record a CUDA graph for them."""
        if count <= _RUNS_BEFORE_CAPTURE or key[-2:] not in self._checked:
            return False
        # Replace the least used CUDA graph only if ``key`` occurred at least twice as often as the graph's key.
        return len(self.recordings) < self._room or count >= 2 * self._counts[self._rarest()]

    def _rarest(self) -> Key:
        return min(self.recordings, key=lambda known: self._counts[known])

    def _drop(self, key: Key, unfit: list[Slot]) -> None:
        """Delete a CUDA graph, because the tensors of the attributes ``unfit`` do not fit into the graph's memory."""
        del self.recordings[key]
        self._values.add_flags(unfit)
        self._mismatches += 1
        if self._mismatches > _MOST_MISMATCHES:
            self._give_up(f"{unfit[0]} holds other memory again and again")

    def _warn_of_changes(self, key: Key) -> None:
        self._missed += 1
        if self._missed == _MANY:
            changed = self._values.difference(self._last[-2:], key[-2:])
            self._warn(f"{changed} changes again and again")
        if not self.recordings:
            self._last = key

    def _give_up(self, reason: str) -> None:
        self.fails = True
        self.recordings.clear()
        self._warn(reason)

    def _warn(self, reason: str) -> None:
        name = getattr(getattr(self._work, "func", self._work), "__name__", "part").strip("_")
        warnings.warn(f"the part '{name}' of the step runs without a CUDA graph: {reason}", stacklevel=5)

    def _run_checked(self, args: tuple[Any, ...], state: Key) -> Any:
        """Run the captured method without a CUDA graph, and find the attributes that the method changes."""
        values = self._values
        before = [(slot, slot.get()) for slot in values.slots()]
        undeclared = dict(values.undeclared())
        states = [(stream, stream.get_state()) for stream in self._streams()]
        found = self._run(args)
        moved = [stream for stream, was in states if not torch.equal(stream.get_state(), was)]
        self._drawn += [stream for stream in moved if not any(stream is known for known in self._drawn)]
        flags = []
        for slot, was in before:
            now = slot.get()
            if isinstance(was, torch.Tensor) and isinstance(now, torch.Tensor):
                if now is not was and form_of(now) == form_of(was):
                    values.rebound.add(slot.id)
            elif type(was) in (int, float) and type(now) in (int, float) and now != was:
                self._give_up(f"{slot} counts; use a tensor that is changed in place")
            elif is_changed(was, now):
                flags.append(slot)
        values.add_flags(flags)
        if changed := next(values.undeclared_changes(undeclared), None):
            self._give_up(f"{changed} changes, and is neither a tensor nor a number")
        self._checked.add(state)
        return found

    def _try_to_record(self, args: tuple[Any, ...]) -> Recording | None:
        """Return a CUDA graph of the method, or None if recording fails, as for methods that wait for the GPU."""
        # First try only the random streams in use, because each registered stream adds two kernel launches to a replay.
        for streams in (self._drawn, self._streams()):
            try:
                return self._record(args, self._make_graph(streams))
            except (RuntimeError, SimulationFailure) as error:
                if not isinstance(error, RuntimeError) and not isinstance(error.__cause__, RuntimeError):
                    raise
                reason = str(error).splitlines()[0]
        self._give_up(reason)
        return None

    def _record(self, args: tuple[Any, ...], graph: Graph) -> Recording:
        values = self._values
        found = list(values.slots())
        values.move_rebound(found)
        before = [(slot, slot.get()) for slot in found]
        tensors = [(slot, value) for slot, value in before if isinstance(value, torch.Tensor)]
        others = [(slot, value) for slot, value in before if is_plain(value) or isinstance(value, tuple)]
        dictionaries = [(slot, dict(value)) for slot, value in before if isinstance(value, dict)]
        with torch.inference_mode(False):
            inputs = [arg.clone() if isinstance(arg, torch.Tensor) else arg for arg in args]
        touched, outputs = captured_values.TouchedMemory(), list[Any]()

        def work() -> None:
            with touched:
                result = self._work(*inputs)
                if self.is_reset:
                    # Stack the logged numbers of a reset, because one tensor is faster to copy than many tensors.
                    if not all(isinstance(value, torch.Tensor) for value in result.values()):
                        raise RuntimeError("the log of a reset must contain only tensors, but contains another value")
                    result = list(result), torch.stack([value.reshape(()) for value in result.values()])
                outputs.append(result)
                captured_values.write_back(tensors)

        try:
            graph.record(work)
        except Exception:
            # Restore the attributes, because a failed capture has assigned tensors whose values no kernel has computed.
            for slot, content in dictionaries:
                slot.set(content)
            for slot, value in (*tensors, *others):
                slot.set(value)
            raise
        assigned = [(slot, slot.get()) for slot, value in (*tensors, *others) if slot.get() is not value]
        values.add_flags([slot for slot, value in (*tensors, *others) if is_changed(value, slot.get())])
        filled = [
            (slot, dict(slot.get())) for slot, was in dictionaries if captured_values.has_other_entries(slot.get(), was)
        ]
        touched.note((outputs, inputs, [v for _, v in assigned], [c for _, c in filled]))
        buffers = [(slot, value) for slot, value in tensors if touched.has(value)]
        return Recording(graph, inputs, buffers, assigned, filled, captured_values.frozen(outputs[0]))
