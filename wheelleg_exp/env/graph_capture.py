"""Capture the parts of an environment's step as CUDA graphs: one launch instead of hundreds of small kernels.

A CUDA graph repeats kernels on fixed memory and does not run Python. So ``GraphCapture`` runs a method twice as Python
code before it records a CUDA graph, and must know what the method reads and writes: what the environment's parts have
declared (see ``wheelleg_exp.state.Stateful``).

- A captured method may change a declared **buffer** in place, or assign a new tensor of the same shape. The graph
  copies the new tensor into the old one.
- Declared **numbers** and the **settings** of terms are the key of a recording. ``GraphCapture`` records one CUDA graph
  for each combination of their values that occurs three times. A captured method may also change a number, if its new
  value depends only on the old numbers: then each replay assigns the recorded value.
- A method that counts, changes anything undeclared, or waits for the GPU, runs without a CUDA graph, with a warning.
"""

from __future__ import annotations

import functools
import operator
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from types import MethodType
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from wheelleg_exp.env.undeclared import UndeclaredChanges
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.managers.manager_base import Term
from wheelleg_exp.state import Stateful, tree
from wheelleg_exp.state.stateful import declarations
from wheelleg_exp.state.values import SCALARS, same, snapshot

# After two runs of a method, lazily created tensors exist, and CUDA libraries have allocated their workspaces.
_RUNS_BEFORE_CAPTURE = 2
# Record at most 8 CUDA graphs per method, and 128 for the reset: one per number of reset environments.
_RECORDINGS, _RESET_RECORDINGS = 8, 128
# Recording costs several runs as Python code. So forget a key that did not occur among the last 16 x 8 calls (16 x 128
# for the reset), and replace only a CUDA graph that was not used in these calls.
_CALLS_PER_RECORDING = 16
# If the memory of a buffer has changed, record the CUDA graph from scratch after 64 runs as Python code.
_RUNS_AFTER_MISMATCH = 64
# Warn when a method's runs as Python code outnumber the replays of its CUDA graphs by 256.
_MANY = 256

Key = tuple[Any, ...]
Method = TypeVar("Method", bound=Callable[..., object])


def captured_part(method: Method) -> Method:
    """Mark a method of the environment's step that may be captured as a CUDA graph."""

    @functools.wraps(method)
    def run(env: Any, *args: object) -> object:
        return method(env, *args) if env.graph_capture is None else env.graph_capture.run(method, args)

    return cast(Method, run)


class CudaGraph:
    """A CUDA graph that advances the random streams ``generators`` with each replay. Tests use a substitute."""

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


class Slot(NamedTuple):
    """A declared attribute of a part, or an entry of a dictionary or list in this attribute.

    ``value`` is the value when ``GraphCapture.slots`` listed the slot, and ``now`` is the present value.
    """

    holder: Any
    key: Any
    value: Any
    label: str
    holds_tensors: bool

    @property
    def id(self) -> tuple[int, object]:
        """The identity of the place."""
        return id(self.holder), self.key

    @property
    def now(self) -> Any:
        """The present value, or None if the dictionary or list no longer has the entry."""
        try:
            return self.holder[self.key]
        except LookupError:
            return None

    @property
    def has_other_tensor(self) -> bool:
        """Whether the place has got another tensor of the same form."""
        return self.now is not self.value and fits(self.now, self.value)


def _slots_in(holder: Any, key: object, name: str, owner: str, is_buffer: bool) -> Iterator[Slot]:
    value = holder[key]
    is_container = isinstance(value, (dict, list))
    holds_tensors = isinstance(value, torch.Tensor) or (is_buffer and is_container)
    yield Slot(holder, key, value, f"'{name}' of {owner}", holds_tensors)
    if is_container:
        for inner in list(value) if isinstance(value, dict) else range(len(value)):
            yield from _slots_in(value, inner, f"{name}.{inner}", owner, is_buffer)


def keep_tensors(slots: Sequence[Slot]) -> None:
    """Copy the present tensor of each slot into the slot's earlier tensor, and assign the earlier tensor again."""
    if not slots:
        return
    targets = {_address(slot.value) for slot in slots}
    # The tensors of different slots may share memory, so first clone the tensors that would be overwritten.
    copies = [now.clone() if _address(now) in targets else now for now in [slot.now for slot in slots]]
    for slot, copy in zip(slots, copies, strict=True):
        slot.value.copy_(copy)
        slot.holder[slot.key] = slot.value


def _address(tensor: torch.Tensor) -> int:
    """Return the address of a tensor's storage, because all views of a tensor share its storage."""
    return tensor.untyped_storage().data_ptr()


def _memory(tree: object) -> set[int]:
    return {_address(leaf) for leaf in tree_leaves(tree) if isinstance(leaf, torch.Tensor)}


class TouchedMemory(TorchDispatchMode):
    """Records the memory addresses of all tensors that torch operations read or write."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.addresses = set[int]()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        del types
        result = operation(*args, **(kwargs or {}))
        self.addresses |= _memory((args, kwargs, result))
        return result


def kind_of(value: object) -> object:
    """Return what a CUDA graph depends on in a value: its type, and the plain value or the form of the tensor."""
    if isinstance(value, torch.Tensor):
        return type(value), value.shape, value.dtype, value.device
    if is_plain(value):
        return type(value), value
    # Bound methods are equal if their objects are identical; and the method keeps the tuple alive.
    return value.__len__ if isinstance(value, tuple) else type(value)


def fits(value: object, tensor: object) -> bool:
    """Return whether both values are tensors of the same form, so that one can be copied into the other."""
    return isinstance(tensor, torch.Tensor) and kind_of(value) == kind_of(tensor)


def is_plain(value: object) -> bool:
    """Return whether a value is a number, a text, None, or a tuple of these."""
    return isinstance(value, SCALARS) or (type(value) is tuple and all(map(is_plain, value)))


def _frame(value: object, holds_tensors: bool) -> object:
    """Return what must not change in a declared value: the sizes of containers, and values that have no slot."""
    if isinstance(value, list) or (isinstance(value, dict) and not holds_tensors):
        return len(value)
    return None if isinstance(value, (torch.Tensor, Stateful, dict)) or is_plain(value) else snapshot(value)


class GraphCapture:
    """Runs the captured methods of an environment's step as Python code at first, and as CUDA graphs later.

    A number that a captured method changes (a *flag*) is read before each replay of a CUDA graph. All other numbers and
    settings can change only in Python code, and are read only after such code.

    Attributes:
        is_checked: whether no code that may change settings has run since the settings were last compared.
        statics: the tensors that all CUDA graphs share, by the ids of slots to which captured methods assign tensors.
    """

    def __init__(self, env: Any, make_graph: Callable[[Sequence[torch.Generator]], CudaGraph] = CudaGraph) -> None:
        # Select environments by masks, because masks have a fixed shape, whereas the number of indices varies.
        env.observation_manager.in_masks = True
        # Reset the curriculum manager without CUDA graphs, because it logs Python numbers.
        env.reset_order.remove(env.curriculum_manager)
        self.env, self.make_graph = env, make_graph
        self.parts: dict[str, CapturedPart] = {}
        self.is_checked = False
        self.statics: dict[tuple[int, object], torch.Tensor | None] = {}
        self._flags: dict[tuple[int, object], Slot] = {}
        self._places: list[tuple[Any, Any]] = []  # the holder and the key of each setting
        self._present: list[object] = []
        self._sizes: list[tuple[Sized, int]] = []
        self._identify = functools.lru_cache(64)(lambda _: object())

    def run(self, method: Callable[..., object], args: tuple[object, ...]) -> object:
        """Run a method of the environment's step, or replay a CUDA graph that was recorded from the method."""
        env, name = self.env, method.__name__
        if name not in self.parts:
            is_reset = any(isinstance(arg, torch.Tensor) and arg.dtype == torch.long for arg in args)
            self.parts[name] = CapturedPart(self, MethodType(method, env), is_reset)
        part = self.parts[name]
        env.scene.robot.data.invalidate()
        found: Any = part(*[arg.to(env.device) if isinstance(arg, torch.Tensor) else arg for arg in args])
        if part.is_reset:
            env.scene.robot.mark_written(args[0])
            found.update(env.curriculum_manager.reset(args[0]))
            self.is_checked &= not env.curriculum_manager.active_terms
        return found

    def slots(self) -> list[Slot]:
        """Return the slots of the environment and its parts, except event terms whose mode is not ``reset``."""
        found: list[Slot] = []
        for part in {id(part): part for _, part in tree(self.env)}.values():
            # No CUDA graph runs an event term that runs outside of resets.
            if not isinstance(part, Term) or part.fields.get("mode", "reset") == "reset":
                owner = getattr(part, "path", type(part).__name__)
                for name, declared in declarations(part).items():
                    if declared.kind != "part":
                        found += _slots_in(vars(part), name, name, owner, declared.kind == "buffer")
        return found

    def key(self) -> Key:
        """Return the key of a CUDA graph: an object for the values of all settings, and the values of all flags."""
        if not self.is_checked:
            self._compare_settings()
            self.is_checked = True
        return self._settings_id, tuple([kind_of(slot.now) for slot in self._flags.values()])

    def add_flags(self, found: Iterable[Slot]) -> None:
        """Include the slots ``found`` in the keys of CUDA graphs. CUDA graphs with older keys are used no more."""
        if new := {slot.id: slot for slot in found if slot.id not in self._flags}:
            self._flags |= new
            self.is_checked, self._places = False, []

    def _compare_settings(self) -> None:
        """Set ``_settings_id``, which identifies the combination of the settings' values.

        Most calls find no change and must be fast, so first compare the identities of the values.
        """
        try:
            now = [holder[key] for holder, key in self._places]
            is_known = bool(now) and not any([len(one) != size for one, size in self._sizes])
        except LookupError:
            is_known = False
        if is_known and all(map(operator.is_, now, self._present)):
            return
        # Find the settings again if code has replaced a dictionary or list, or changed its size.
        pairs = zip(now, self._present, strict=True) if is_known else ()
        if not is_known or any(new is not old and isinstance(new, (dict, list)) for new, old in pairs):
            settings = [slot for slot in self.slots() if slot.id not in self._flags and not slot.holds_tensors]
            self._places, now = [slot[:2] for slot in settings], [slot.value for slot in settings]
            self._sizes = [(value, len(value)) for value in now if isinstance(value, (dict, list))]
        self._present = now
        self._settings_id = self._identify(tuple(map(kind_of, now)))


@dataclass
class Recording:
    """A recorded CUDA graph of a method, and the declared values that each replay reads and assigns.

    Attributes:
        output: the result of the method, in the memory of the CUDA graph.
        buffers: the slots of the tensors that the method reads or writes, with the CUDA graph's tensors as values.
        fixed: the slots that must still have their values: tensors that share memory, and containers of buffers.
        assigned: the holder, the key, and the value of each slot to which the method assigns a value.
        removed: the slots of the dictionary entries that the method deletes.
        used: the number of the method's call that last used the CUDA graph.
    """

    graph: CudaGraph
    inputs: list[object]
    output: Any
    buffers: list[Slot]
    fixed: list[Slot]
    assigned: list[tuple[Any, Any, object]]
    removed: list[Slot]
    used: int = 0

    def load(self, args: tuple[object, ...]) -> Slot | None:
        """Copy buffers and arguments to the CUDA graph's tensors; return a slot whose value does not fit."""
        try:
            unfit = [slot for slot in self.fixed if slot[0][slot[1]] is not slot[2]]
            moved = [slot for slot in self.buffers if slot[0][slot[1]] is not slot[2]]
        except LookupError:
            return next(slot for slot in (*self.fixed, *self.buffers) if slot.now is None)
        unfit += [slot for slot in moved if not slot.has_other_tensor]
        if unfit:
            return unfit[0]
        keep_tensors(moved)
        for arg, now in zip(self.inputs, args, strict=True):
            if isinstance(arg, torch.Tensor) and isinstance(now, torch.Tensor):
                arg.copy_(now)
        return None

    def replay(self) -> Any:
        """Replay the CUDA graph, and repeat the method's assignments, which are not part of the graph."""
        self.graph.replay()
        for slot in self.removed:
            slot.holder.pop(slot.key, None)
        for holder, key, value in self.assigned:
            holder[key] = value
        return self.output


class CapturedPart:
    """One method of the environment's step, and the CUDA graphs recorded from it, the least recently used one first.

    If ``is_reset``, the method resets any number of environments, and returns a dictionary of logged numbers.
    """

    def __init__(self, capture: GraphCapture, method: Callable[..., Any], is_reset: bool = False) -> None:
        self._capture, self._method, self.is_reset = capture, method, is_reset
        self.fails = False  # whether the method runs without CUDA graphs from now on
        self.recordings: dict[Key, Recording] = {}
        self._room = _RESET_RECORDINGS if is_reset else _RECORDINGS
        self._patience = _CALLS_PER_RECORDING * self._room
        self._times: dict[Key, int] = {}  # how often keys without a recording occurred; the first one is the oldest
        self._calls = self._missed = 0
        self._changing = ""  # the label of a buffer whose memory has changed
        self._checked = set[Key]()
        self._drawn = set[torch.Generator]()

    def __call__(self, *args: object) -> object:
        """Run the method, or replay a CUDA graph that was recorded from the method."""
        if self.fails:
            return self._run(args)
        self._calls += 1
        state = self._capture.key()
        key = (*map(kind_of, args), *state)
        recording = self.recordings.pop(key, None)
        if recording is not None and (unfit := recording.load(args)):
            self._capture.add_flags([unfit])
            self._changing = unfit.label
            self._times[key], recording = -_RUNS_AFTER_MISMATCH, None
        if recording is None:
            times = self._times[key] = self._times.pop(key, 0) + 1
            if len(self._times) > self._patience:
                del self._times[next(iter(self._times))]
            if state not in self._checked and self._calls > 1 and (times > 1 or not self._checked):
                return self._run_checked(args, state)
            recording = self._try_to_record(args) if times > _RUNS_BEFORE_CAPTURE and self._has_room() else None
            if recording is None:
                self._missed += 1
                if self._missed == _MANY - 1:
                    self._before = [slot for slot in self._capture.slots() if not slot.holds_tensors]
                elif self._missed == _MANY:
                    changed = (slot.label for slot in self._before if kind_of(slot.value) != kind_of(slot.now))
                    other = self._changing or ("the number of environments" if self.is_reset else "the set of values")
                    self._warn(f"{next(changed, other)} changes again and again")
                return self._run(args)
            del self._times[key]
            self._changing = ""
        self.recordings[key], recording.used = recording, self._calls
        self._missed -= self._missed > 0
        output = recording.replay()
        return dict(zip(output[0], output[1].clone().unbind(), strict=True)) if self.is_reset else output

    def _has_room(self) -> bool:
        """Return whether one more CUDA graph may be recorded; delete one that was not used for long if necessary."""
        if len(self.recordings) >= self._room:
            oldest = next(iter(self.recordings))
            if self._calls - self.recordings[oldest].used <= self._patience:
                return False
            del self.recordings[oldest]
        return True

    def _run(self, args: tuple[object, ...]) -> object:
        self._capture.is_checked = False  # Python code may change any attribute of the environment.
        return self._method(*args)

    def _give_up(self, reason: str) -> None:
        if not self.fails:
            self.fails = True
            self.recordings.clear()
            self._warn(reason)

    def _warn(self, reason: str) -> None:
        name = self._method.__name__.strip("_")
        warnings.warn(f"the part '{name}' of the step runs without a CUDA graph: {reason}", stacklevel=5)

    def _run_checked(self, args: tuple[object, ...], state: Key) -> object:
        """Run the captured method without a CUDA graph, and find the declared values that the method changes."""
        capture = self._capture
        before = [(slot, _frame(slot.value, slot.holds_tensors)) for slot in capture.slots()]
        undeclared = UndeclaredChanges(capture.env, with_root=True)
        streams = [(stream, stream.get_state()) for stream in capture.env.streams.all()]
        found = self._run(args)
        self._drawn |= {stream for stream, was in streams if not torch.equal(stream.get_state(), was)}
        for slot, frame in before:
            was, now = slot.value, slot.now
            if slot.has_other_tensor:
                capture.statics.setdefault(slot.id, None)
            elif type(was) in (int, float) and type(now) in (int, float) and now != was:
                self._give_up(f"{slot.label} counts; use a buffer that is changed in place")
            elif was is not None and not same(_frame(now, slot.holds_tensors), frame):
                self._give_up(f"{slot.label} changes, and is neither a tensor nor a number")
            elif kind_of(was) != kind_of(now):
                capture.add_flags([slot])
        for owner, name in undeclared.changed():
            self._give_up(f"'{name}' of {type(owner).__name__} changes, and is not declared")
        self._checked.add(state)
        return found

    def _try_to_record(self, args: tuple[object, ...]) -> Recording | None:
        """Return a CUDA graph of the method, or None if recording fails, as for methods that wait for the GPU."""
        # First try only the random streams in use, because each registered stream adds two kernel launches to a replay.
        for streams in ([*self._drawn], self._capture.env.streams.all()):
            try:
                return self._record(args, self._capture.make_graph(streams))
            except (RuntimeError, SimulationFailure) as error:
                if not isinstance(error, RuntimeError) and not isinstance(error.__cause__, RuntimeError):
                    raise
                reason = str(error).splitlines()[0]
        self._give_up(reason)
        return None

    def _record(self, args: tuple[object, ...], graph: CudaGraph) -> Recording:
        capture, statics = self._capture, self._capture.statics
        # Tensors made in inference mode cannot be written in place outside of inference mode.
        with torch.inference_mode(False), torch.no_grad():
            inputs = [arg.clone() if isinstance(arg, torch.Tensor) else arg for arg in args]
            own = [slot for slot in capture.slots() if slot.id in statics and isinstance(slot.value, torch.Tensor)]
            for slot in own:
                if not fits(slot.value, statics[slot.id]):
                    statics[slot.id] = torch.empty_like(slot.value)
            keep_tensors([slot._replace(value=statics[slot.id]) for slot in own])
        before = capture.slots()
        earlier = {slot.id: slot.value for slot in before}
        tensors = [slot for slot in before if isinstance(slot.value, torch.Tensor)]
        touched, outputs = TouchedMemory(), list[Any]()

        def work() -> None:
            with touched:
                result = self._method(*inputs)
                if self.is_reset:
                    # Stack the logged numbers of a reset, because one tensor is faster to copy than many tensors.
                    if not all(isinstance(value, torch.Tensor) for value in result.values()):
                        raise RuntimeError("the log of a reset must contain only tensors, but contains another value")
                    result = list(result), torch.stack([value.reshape(()) for value in result.values()])
                outputs.append(result)
                # Each replay reads and writes the same memory, so slots must keep their tensors.
                keep_tensors([slot for slot in tensors if slot.has_other_tensor])

        try:
            graph.record(work)
        except Exception:
            # Restore all values, because a failed capture has assigned tensors whose values no kernel has computed.
            for slot in reversed(capture.slots()):
                is_attribute = isinstance(slot.holder, dict) and "_declared" in slot.holder
                if slot.id not in earlier and not is_attribute:
                    del slot.holder[slot.key]
            for slot in before:
                slot.holder[slot.key] = slot.value
            capture.env.scene.robot.data.invalidate()
            raise
        capture.add_flags(slot for slot in before if kind_of(slot.value) != kind_of(slot.now))
        assigned = [slot for slot in capture.slots() if slot.id not in earlier or earlier[slot.id] is not slot.value]
        removed = [slot for slot in before if isinstance(slot.holder, dict) and slot.key not in slot.holder]
        memory = touched.addresses | _memory((outputs, inputs, [slot.value for slot in assigned]))
        buffers = [slot for slot in tensors if _address(slot.value) in memory]
        # Other values cannot be copied into a tensor whose memory several slots use.
        uses = Counter(_address(slot.value) for slot in buffers)
        pinned = {id(slot.value) for slot in buffers if uses[_address(slot.value)] > 1}
        pinned |= {id(slot.holder) for slot in buffers}
        for slot in reversed(before):  # inner containers before outer ones
            if id(slot.value) in pinned:
                pinned.add(id(slot.holder))
        fixed = [slot for slot in before if id(slot.value) in pinned]
        buffers = [slot for slot in buffers if id(slot.value) not in pinned]
        # Copy the containers of the output, but not its tensors: the method may change its containers later.
        output = tree_map(lambda leaf: leaf, outputs[0])
        return Recording(graph, inputs, output, buffers, fixed, [slot[:3] for slot in assigned], removed)
