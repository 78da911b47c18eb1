"""Capture the parts of an environment's step as CUDA graphs: one launch instead of hundreds of small kernels.

The decorator ``captured_part`` marks a method of the environment as a part of the environment's step. Without CUDA
graphs, such a method runs as Python code. ``GraphCapture`` runs it twice as Python code, records it as a CUDA graph,
and then replays this graph.

A CUDA graph repeats kernels on fixed memory and does not run Python, so ``GraphCapture`` must know what a recorded
method reads and writes: what the environment's parts have declared (see ``wheelleg_exp.state.Stateful``).

- A captured method may change a declared **buffer** in place, or assign a new tensor of the same shape. The graph
  copies the new tensor into the old one.
- Declared **numbers** and the **settings** of terms are the key of a recording. ``GraphCapture`` records one CUDA graph
  for each combination of their values that occurs three times. A captured method may also change a number, if its new
  value depends only on the old numbers: then each replay assigns the recorded value.
- A method that counts, that changes anything undeclared, or that waits for the GPU, runs without a CUDA graph. A
  warning names the reason.
"""

from __future__ import annotations

import functools
import itertools
import operator
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, field
from numbers import Number
from typing import Any, NamedTuple, Protocol, TypeGuard, TypeVar, cast

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from wheelleg_exp.env.undeclared import UndeclaredChanges
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.managers.manager_base import Term
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.state import Stateful, cloned, tree
from wheelleg_exp.state.stateful import declarations
from wheelleg_exp.state.values import PLAIN, same, snapshot

# After two runs of a method, lazily created tensors exist, and CUDA libraries have allocated their workspaces.
_RUNS_BEFORE_CAPTURE = 2
# Record at most 8 CUDA graphs per method, and 128 for the reset: one per number of reset environments.
_RECORDINGS, _RESET_RECORDINGS = 8, 128
# Recording costs several runs as Python code. So forget a key that did not occur among the last 16 x 8 calls (16 x 128
# for the reset), and replace only a CUDA graph that was not used in these calls.
_CALLS_PER_RECORDING = 16
# Warn when a method's runs as Python code outnumber the replays of its CUDA graphs by 256.
_MANY = 256
_MOST_MISMATCHES = 64
_MOST_KNOWN = 64  # numbered combinations of settings

Key = tuple[Any, ...]
Method = TypeVar("Method", bound=Callable[..., object])


class CapturedEnv(Env, Protocol):
    """An environment of whose step parts can be captured."""

    graph_capture: GraphCapture | None
    reset_order: list[Any]


def captured_part(
    *, to_caller: bool = False, in_python: Callable[..., bool] | None = None
) -> Callable[[Method], Method]:
    """Mark a method of the environment's step that may be captured as a CUDA graph.

    If ``to_caller`` is true, the environment returns the result to its caller, so ``GraphCapture`` copies the result
    out of the CUDA graph's memory. If ``in_python`` returns True for the arguments, the method runs as Python code.
    """

    def decorate(method: Method) -> Method:
        @functools.wraps(method)
        def run(env: CapturedEnv, *args: object) -> object:
            if env.graph_capture is None or (in_python is not None and in_python(*args)):
                return method(env, *args)
            return env.graph_capture.run(method, args, to_caller=to_caller)

        return cast(Method, run)

    return decorate


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
    """A place of a declared value: an attribute of a part, or an entry of a dictionary or list in this attribute."""

    holder: Any
    key: Any
    label: str
    is_buffer: bool

    @property
    def id(self) -> tuple[int, object]:
        """The identity of the place."""
        return id(self.holder), self.key

    @property
    def value(self) -> object:
        """The present value; the entry of a dictionary or list may be missing, which gives None."""
        try:
            return self.holder[self.key]
        except LookupError:
            return None


def _slots_in(holder: Any, key: object, name: str, owner: str, is_buffer: bool) -> Iterator[Slot]:
    yield Slot(holder, key, f"'{name}' of {owner}", is_buffer)
    if isinstance(value := holder[key], (dict, list)):
        for inner in list(value) if isinstance(value, dict) else range(len(value)):
            yield from _slots_in(value, inner, f"{name}.{inner}", owner, is_buffer)


class Values:
    """The declared values of an environment and its parts.

    A number that a captured method changes (a *flag*) is read before each replay of a CUDA graph. All other numbers and
    settings can change only in Python code, and are read only after such code.

    Attributes:
        is_checked: whether no code that may change settings has run since the settings were last compared.
        rebound: the ids of slots to which a captured method assigns another tensor.
    """

    def __init__(self, root: object) -> None:
        self.root = root
        self.is_checked = False
        self.rebound = set[tuple[int, object]]()
        self._statics: dict[tuple[int, object], torch.Tensor] = {}
        self._flags: dict[tuple[int, object], Slot] = {}
        self._settings: list[Slot] = []
        self._places: list[tuple[Any, Any]] = []
        self._present: list[object] = []
        self._sizes: list[tuple[Sized, int]] = []
        self._known: dict[Key, tuple[int, list[object]]] = {}
        self._number, self._numbers = -1, itertools.count()

    def slots(self) -> list[Slot]:
        """Return the slots of the environment and its parts, except event terms whose mode is not ``reset``."""
        found: list[Slot] = []
        for part in {id(part): part for _, part in tree(self.root)}.values():
            # No CUDA graph runs an event term that runs outside of resets.
            if not isinstance(part, Term) or part.fields.get("mode", "reset") == "reset":
                owner = getattr(part, "path", type(part).__name__)
                for name, declared in declarations(part).items():
                    if declared.kind != "part":
                        found += _slots_in(vars(part), name, name, owner, declared.kind == "buffer")
        return found

    def key(self) -> Key:
        """Return the key of a CUDA graph: a number for the values of all settings, and the values of all flags."""
        if not self.is_checked:
            self._check()
            self.is_checked = True
        return self._number, tuple([kind_of(slot.value) for slot in self._flags.values()])

    def add_flags(self, found: Iterable[Slot]) -> None:
        """Include the slots ``found`` in the keys of CUDA graphs. CUDA graphs with older keys are used no more."""
        if new := {slot.id: slot for slot in found if slot.id not in self._flags}:
            self._flags |= new
            self.is_checked, self._settings = False, []

    def difference(self, before: Key, now: Key) -> str:
        """Return the label of a slot that has different values in the CUDA graph keys ``before`` and ``now``."""
        known = {number: settings for settings, (number, _) in self._known.items()}
        pairs = [*zip(self._settings, known.get(before[0], ()), known.get(now[0], ()), strict=False)]
        pairs += zip(self._flags.values(), before[1], now[1], strict=False)
        return next((slot.label for slot, was, value in pairs if was != value), "the set of values")

    def _check(self) -> None:
        """Set ``_number``, which identifies the combination of the settings' values.

        Most calls find no change and must be fast, so ``_check`` first compares the identities of the values.
        """
        before = self._present
        try:
            now = [holder[key] for holder, key in self._places]
            is_same = bool(self._settings) and not any([len(one) != size for one, size in self._sizes])
        except LookupError:
            is_same = False
        if is_same and all(map(operator.is_, now, before)):
            return
        # Find the settings again if code has changed the size of a dictionary or list, or has replaced one.
        containers = (number for number, was in enumerate(before) if isinstance(was, (dict, list)))
        if not is_same or any(now[number] is not before[number] for number in containers):
            self._find_settings()
            now = [slot.value for slot in self._settings]
        self._present = now
        settings = tuple([kind_of(value) for value in now])
        # Re-insert the used entry at the end of ``_known``, so that the first entry is the least recently used one. The
        # values are stored, too, because a key contains the ids of some of them.
        self._number = self._known.pop(settings, (next(self._numbers), now))[0]
        self._known[settings] = self._number, now
        if len(self._known) > _MOST_KNOWN:
            del self._known[next(iter(self._known))]

    def _find_settings(self) -> None:
        self._settings, self._sizes = [], []
        for slot in self.slots():
            value = slot.value
            is_buffer = isinstance(value, torch.Tensor) or (slot.is_buffer and isinstance(value, (dict, list)))
            if slot.id not in self._flags and not is_buffer:
                self._settings.append(slot)
                self._sizes += [(value, len(value))] if isinstance(value, (dict, list)) else []
        self._places = [(slot.holder, slot.key) for slot in self._settings]

    def move_rebound(self, found: Iterable[Slot]) -> None:
        """Replace newly assigned tensors by static tensors with the same values, which all CUDA graphs share."""
        # Tensors made in inference mode cannot be written in place outside of inference mode.
        with torch.inference_mode(False), torch.no_grad():
            for slot in (slot for slot in found if slot.id in self.rebound):
                value, static = slot.value, self._statics.get(slot.id)
                if isinstance(value, torch.Tensor) and static is not value:
                    if static is not None and _fits(static, value):
                        static.copy_(value.clone())
                    else:
                        static = self._statics[slot.id] = value.detach().clone()
                    slot.holder[slot.key] = static


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


def form_of(value: object) -> object:
    """Return the shape, dtype, and device of a tensor; return a value of another type unchanged."""
    return (value.shape, value.dtype, value.device) if isinstance(value, torch.Tensor) else value


def _fits(value: object, old: torch.Tensor) -> TypeGuard[torch.Tensor]:
    return isinstance(value, torch.Tensor) and form_of(value) == form_of(old)


def kind_of(value: object) -> object:
    """Return what a CUDA graph depends on in a value: its type, and a plain value or the form of a tensor."""
    if is_plain(value) or isinstance(value, torch.Tensor):
        return type(value), form_of(value)
    return id(value) if isinstance(value, tuple) else type(value)


def is_plain(value: object) -> bool:
    """Return whether a value is a number, a text, None, or a tuple of these."""
    return type(value) in PLAIN or isinstance(value, Number) or (type(value) is tuple and all(map(is_plain, value)))


def _frame(value: object) -> object:
    """Return what must not change in a declared value: the sizes of containers, and values that have no slot."""
    if isinstance(value, (dict, list)):
        return len(value)
    has_slot = isinstance(value, (torch.Tensor, Stateful)) or is_plain(value)
    return None if has_slot else snapshot(value)


def _copy(pairs: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> None:
    """Copy the second tensor of each pair into the first; tensors of different pairs may share memory."""
    targets = {_address(static) for static, _ in pairs}
    copies = [(static, now.clone() if _address(now) in targets else now) for static, now in pairs]
    for static, now in copies:
        static.copy_(now)


class GraphCapture:
    """Runs the captured methods of an environment's step as Python code at first, and as CUDA graphs later."""

    def __init__(
        self, env: CapturedEnv, make_graph: Callable[[Sequence[torch.Generator]], CudaGraph] = CudaGraph
    ) -> None:
        # Select environments by masks, because masks have a fixed shape, whereas the number of indices varies.
        env.observation_manager.in_masks = True
        # Reset the curriculum and recorder managers without CUDA graphs, because these managers log Python numbers.
        self._reset_later: list[Any] = [env.curriculum_manager, env.recorder_manager]
        env.reset_order = [manager for manager in env.reset_order if manager not in self._reset_later]
        self._env, self._make_graph = env, make_graph
        self.values = Values(env)
        self.parts: dict[str, CapturedPart] = {}

    @property
    def recordings(self) -> int:
        """The number of recorded CUDA graphs of all captured methods."""
        return sum(len(part.recordings) for part in self.parts.values())

    def run(self, method: Callable[..., object], args: tuple[object, ...], *, to_caller: bool) -> object:
        """Run a method of the environment's step, or replay a CUDA graph that was recorded from the method."""
        env = self._env
        name = method.__name__
        if name not in self.parts:
            resets = any(isinstance(arg, torch.Tensor) and arg.dtype == torch.long for arg in args)
            work, caches, streams = functools.partial(method, env), env.scene.robot.data.invalidate, env.streams.all
            self.parts[name] = CapturedPart(work, self.values, self._make_graph, caches, streams, resets)
        part = self.parts[name]
        found: Any = part(*[arg.to(env.device) if isinstance(arg, torch.Tensor) else arg for arg in args])
        if part.is_reset:
            ids = cast(torch.Tensor, args[0])
            env.scene.robot.mark_written(ids)
            for manager in self._reset_later:
                found.update(manager.reset(ids))
                self.values.is_checked &= not manager.active_terms
        return cloned(found) if to_caller else found


@dataclass
class Recording:
    """A recorded CUDA graph of a method, and the declared values that each replay reads and assigns.

    Attributes:
        buffers: the slots of the tensors that the method reads or writes, and the CUDA graph's tensor for each slot.
        containers: the slots of the dictionaries and lists that hold these slots, and these dictionaries and lists.
        assigned: the places to which the method assigns a value: the holder, the key, and the value.
        output: the result of the method, in the memory of the CUDA graph.
        removed: the dictionary entries that the method deletes: the dictionary and the key.
        tuples: the values whose ids are part of the recording's key, so that no other value gets the same id.
        used: the number of the method's call that last used the CUDA graph.
    """

    graph: CudaGraph
    inputs: list[object]
    buffers: list[tuple[Slot, torch.Tensor]]
    containers: list[tuple[Slot, object]]
    assigned: list[tuple[Any, Any, object]]
    output: Any
    removed: list[tuple[Any, Any]]
    tuples: list[object]
    used: int = 0

    def __post_init__(self) -> None:
        counts = Counter(_address(static) for _, static in self.buffers)
        # Other values cannot be copied into a tensor whose memory several slots use.
        self._shared = {id(static) for _, static in self.buffers if counts[_address(static)] > 1}

    def load(self, args: tuple[object, ...]) -> Slot | None:
        """Copy buffers and arguments to the CUDA graph's tensors; return a slot whose value does not fit."""
        for slot, container in self.containers:
            if slot.value is not container:
                return slot
        try:
            moved = [(slot, own, now) for slot, own in self.buffers if (now := slot[0][slot[1]]) is not own]
        except LookupError:
            return next(slot for slot, _ in self.buffers if slot.value is None)
        for slot, own, now in moved:
            if id(own) in self._shared or not _fits(now, own):
                return slot
        _copy([(own, now) for _, own, now in moved])
        for slot, own, _ in moved:
            slot.holder[slot.key] = own
        for arg, now in zip(self.inputs, args, strict=True):
            if isinstance(arg, torch.Tensor) and isinstance(now, torch.Tensor):
                arg.copy_(now)
        return None

    def replay(self) -> Any:
        """Replay the CUDA graph, and repeat the method's assignments, which are not part of the graph."""
        self.graph.replay()
        for holder, key in self.removed:
            holder.pop(key, None)
        for holder, key, value in self.assigned:
            holder[key] = value
        return self.output


@dataclass
class CapturedPart:
    """One method of the environment's step, and the CUDA graphs recorded from it.

    Attributes:
        work: the method to capture, which returns tensors.
        values: the environment's declared values, which all methods captured from one environment share.
        reset_caches: deletes the robot's cached quantities before each run of the method or replay of a CUDA graph.
        streams: returns all random generators of the environment.
        is_reset: whether ``work`` resets any number of environments, and returns a dictionary of logged numbers.
        fails: whether the method runs without CUDA graphs from now on.
        recordings: the CUDA graphs by their keys; the first one is the least recently used one.
    """

    work: Callable[..., Any]
    values: Values
    make_graph: Callable[[Sequence[torch.Generator]], CudaGraph]
    reset_caches: Callable[[], None] = lambda: None
    streams: Callable[[], Sequence[torch.Generator]] = list
    is_reset: bool = False
    fails: bool = field(default=False, init=False)
    recordings: dict[Key, Recording] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self._room = _RESET_RECORDINGS if self.is_reset else _RECORDINGS
        self._times: dict[Key, int] = {}  # how often keys without a recording occurred; the first one is the oldest
        self._calls = self._mismatches = self._missed = 0
        self._checked = set[Key]()
        self._drawn: list[torch.Generator] = []
        self._last: Key = (-1, ())

    def __call__(self, *args: object) -> object:
        """Run a method of the environment's step, or replay a CUDA graph that was recorded from the method."""
        self.reset_caches()
        if self.fails:
            return self._run(args)
        self._calls += 1
        state = self.values.key()
        key = (*(form_of(arg) for arg in args), *state)
        recording = self.recordings.pop(key, None)
        if recording is None:
            # Re-insert the key at the end of ``_times``, and forget the least recently used key.
            times = self._times[key] = self._times.pop(key, 0) + 1
            if len(self._times) > _CALLS_PER_RECORDING * self._room:
                del self._times[next(iter(self._times))]
            is_due = times >= _RUNS_BEFORE_CAPTURE or (self._calls >= _RUNS_BEFORE_CAPTURE and not self._checked)
            if is_due and state not in self._checked:
                return self._run_checked(args, state)
            is_full = len(self.recordings) >= self._room
            oldest = next(iter(self.recordings.values())).used if is_full else 0
            has_room = not is_full or self._calls - oldest > _CALLS_PER_RECORDING * self._room
            if times <= _RUNS_BEFORE_CAPTURE or not has_room:
                self._missed += 1
                if self._missed == _MANY:
                    self._warn(f"{self.values.difference(self._last, state)} changes again and again")
                self._last = self._last if self.recordings else state
                return self._run(args)
            recording = self._try_to_record(args)
            if recording is None:
                self.reset_caches()
                return self._run(args)
            del self._times[key]
            if is_full:
                del self.recordings[next(iter(self.recordings))]
        elif unfit := recording.load(args):
            self.values.add_flags([unfit])
            self._mismatches += 1
            if self._mismatches > _MOST_MISMATCHES:
                self._give_up(f"{unfit.label} holds other memory again and again")
            return self._run(args)
        self.recordings[key], recording.used = recording, self._calls
        self._missed -= self._missed > 0
        self._last = state
        output = recording.replay()
        return dict(zip(output[0], output[1].clone().unbind(), strict=True)) if self.is_reset else output

    def _run(self, args: tuple[object, ...]) -> object:
        self.values.is_checked = False  # Python code may change any attribute of the environment.
        return self.work(*args)

    def _give_up(self, reason: str) -> None:
        if not self.fails:
            self.fails = True
            self.recordings.clear()
            self._warn(reason)

    def _warn(self, reason: str) -> None:
        name = getattr(getattr(self.work, "func", self.work), "__name__", "part").strip("_")
        warnings.warn(f"the part '{name}' of the step runs without a CUDA graph: {reason}", stacklevel=5)

    def _run_checked(self, args: tuple[object, ...], state: Key) -> object:
        """Run the captured method without a CUDA graph, and find the declared values that the method changes."""
        values = self.values
        before = [(slot, slot.value, None if slot.is_buffer else _frame(slot.value)) for slot in values.slots()]
        undeclared = UndeclaredChanges(values.root, with_root=True)
        streams = [(stream, stream.get_state()) for stream in self.streams()]
        found = self._run(args)
        moved = [stream for stream, was in streams if not torch.equal(stream.get_state(), was)]
        self._drawn += [stream for stream in moved if not any(stream is known for known in self._drawn)]
        for slot, was, frame in before:
            now = slot.value
            if isinstance(was, torch.Tensor) and now is not was and _fits(now, was):
                values.rebound.add(slot.id)
            elif type(was) in (int, float) and type(now) in (int, float) and now != was:
                self._give_up(f"{slot.label} counts; use a buffer that is changed in place")
            elif not slot.is_buffer and not same(_frame(now), frame):
                self._give_up(f"{slot.label} changes, and is neither a tensor nor a number")
            elif kind_of(was) != kind_of(now):
                values.add_flags([slot])
        for owner, name in undeclared.changed():
            self._give_up(f"'{name}' of {type(owner).__name__} changes, and is not declared")
        self._checked.add(state)
        return found

    def _try_to_record(self, args: tuple[object, ...]) -> Recording | None:
        """Return a CUDA graph of the method, or None if recording fails, as for methods that wait for the GPU."""
        # First try only the random streams in use, because each registered stream adds two kernel launches to a replay.
        for streams in (self._drawn, self.streams()):
            try:
                return self._record(args, self.make_graph(streams))
            except (RuntimeError, SimulationFailure) as error:
                if not isinstance(error, RuntimeError) and not isinstance(error.__cause__, RuntimeError):
                    raise
                reason = str(error).splitlines()[0]
        self._give_up(reason)
        return None

    def _record(self, args: tuple[object, ...], graph: CudaGraph) -> Recording:
        values = self.values
        values.move_rebound(values.slots())
        before = {slot.id: (slot, slot.value) for slot in values.slots()}
        tensors = [(slot, value) for slot, value in before.values() if isinstance(value, torch.Tensor)]
        with torch.inference_mode(False):
            inputs = [arg.clone() if isinstance(arg, torch.Tensor) else arg for arg in args]
        touched, outputs = TouchedMemory(), list[Any]()

        def work() -> None:
            with touched:
                result = self.work(*inputs)
                if self.is_reset:
                    # Stack the logged numbers of a reset, because one tensor is faster to copy than many tensors.
                    if not all(isinstance(value, torch.Tensor) for value in result.values()):
                        raise RuntimeError("the log of a reset must contain only tensors, but contains another value")
                    result = list(result), torch.stack([value.reshape(()) for value in result.values()])
                outputs.append(result)
                # Each replay reads and writes the same memory, so slots must keep their tensors: copy new values there.
                moved = [(slot, old, now) for slot, old in tensors if _fits(now := slot.value, old) and now is not old]
                _copy([(old, now) for _, old, now in moved])
                for slot, old, _ in moved:
                    slot.holder[slot.key] = old

        try:
            graph.record(work)
        except Exception:
            # Restore all values, because a failed capture has assigned tensors whose values no kernel has computed.
            for slot in reversed(values.slots()):
                is_attribute = isinstance(slot.holder, dict) and "_declared" in slot.holder
                if slot.id not in before and not is_attribute:
                    del slot.holder[slot.key]
            for slot, value in before.values():
                slot.holder[slot.key] = value
            raise
        values.add_flags(slot for slot, value in before.values() if kind_of(value) != kind_of(slot.value))
        after = values.slots()
        changed = [s for s in after if s.id not in before or before[s.id][1] is not s.value]
        removed = [
            (s.holder, s.key) for s, _ in before.values() if isinstance(s.holder, dict) and s.key not in s.holder
        ]
        tuples: list[object] = [value for _, value in before.values() if isinstance(value, tuple)]
        assigned = [(slot.holder, slot.key, slot.value) for slot in changed]
        memory = touched.addresses | _memory((outputs, inputs, [slot.value for slot in changed]))
        buffers = [(slot, value) for slot, value in tensors if _address(value) in memory]
        holders = {id(slot.holder) for slot, _ in buffers}
        containers = [(slot, value) for slot, value in before.values() if id(value) in holders]
        # Copy the containers of the output, but not its tensors: the method may change its containers later.
        output = tree_map(lambda leaf: leaf, outputs[0])
        return Recording(graph, inputs, buffers, containers, assigned, output, removed, tuples)
