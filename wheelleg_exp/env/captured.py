"""A part of the step that a GPU does as one CUDA graph: many small kernels cost the host one call.

A graph repeats kernels on the memory that they were captured with. What Python does between them is done once, at the
capture, so it is found out and repeated: which attributes hold other tensors afterwards, and which hold other values.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch

from wheelleg_exp.env.recorders import Recorder, Touched
from wheelleg_exp.env.slots import PLAIN, Slot, entry_of, slots
from wheelleg_exp.env.variants import Entry, Memory, Variant, bring, form_of, is_like, places_of, shared_of
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.term import Term

_MOST_VARIANTS, _MOST_PLAIN = 8, 1000
_MOST_AGAIN = 64  # times that all is recorded again, because attributes hold what they did not hold before
_MOST_ENTRIES = 4  # of a part: whether environments have just been reset, and the like, alternates
_WARM_UP = 2  # runs before a capture: what is made lazily is there, and libraries have their workspaces


class Counting(ConfigError):
    """A number counts the runs of a part, and would stand still in a recording.

    Attributes:
        found: what the run returned in which it was noticed; it is done.
    """

    found: Any = None


class Captured:
    """Runs a part of the step, and from its third run on repeats it as recorded.

    What it decides by plain values of the roots it decides anew for each set of them that a run begins with: each has a
    recording of its own. A number that each run changes would stand still in a recording, so it is an error.

    Args:
        work: the part: whole tensors of fixed shapes, which reads and writes what the roots hold, and returns tensors.
        roots: the objects that hold what it reads and writes.
        recorder: makes a recorder of work that draws from some random streams.
        forget: is called before every run; makes the roots forget what they have derived.
        streams: returns all random streams.
        like: another part, which has learned of the roots what this one need not learn again.
        memory: what it shares with other parts.
    """

    def __init__(
        self,
        work: Callable[[], Any],
        roots: Sequence[Any],
        recorder: Callable[[Sequence[torch.Generator]], Recorder],
        forget: Callable[[], None],
        streams: Callable[[], Sequence[torch.Generator]] = list,
        like: Captured | None = None,
        memory: Memory | None = None,
    ) -> None:
        self._memory = memory or Memory()
        self._entries: list[Entry] = []  # the last first
        self._work, self._roots, self._recorder, self._forget = work, roots, recorder, forget
        self._streams = streams
        self._plain: dict[tuple[int, Any], Slot] = {} if like is None else dict(like._plain)
        self._drawn: list[torch.Generator] = [] if like is None else like._drawn
        self._runs: int = 0 if like is None else like._runs
        self._variants: dict[tuple[Any, ...], Variant] = {}
        self._fails, self._again = False, 0

    def __call__(self) -> Any:
        """Run the part, or repeat it."""
        self._forget()
        if self._fails:
            return self._work_itself()
        if self._runs < _WARM_UP:
            self._runs += 1
            return self._run_by_itself()
        self._memory.look()
        for entry in self._entries:
            if entry.enter(self._memory.version):
                return self._replay(entry.variant)
        key = tuple(_kind(slot.get()) for slot in self._plain.values())
        variant = self._variants.get(key)
        if variant is None:
            if len(self._variants) >= _MOST_VARIANTS:
                return self._work_itself()
            found = self._try_to_record()  # which has begun with what is there
            if found is None:
                self._forget()
                return self._work_itself()
            variant = self._variants[key] = found
        elif unlike := self._enter(variant):  # others decide what is there when this begins: recordings depend on it
            self._plain |= {slot.name: slot for slot in unlike}
            self._variants.clear()
            self._entries.clear()
            self._again += 1
            if len(self._plain) > _MOST_PLAIN or self._again > _MOST_AGAIN:
                slot = unlike[0]
                self._give_up(f"'{slot.way[0]}' of {type(slot.holder).__name__} holds other memory again and again")
                return self._work_itself()
            return self()
        return self._replay(variant)

    def _work_itself(self) -> Any:
        self._memory.is_seen = False  # what is not recorded may change whatever it likes
        return self._work()

    @staticmethod
    def _replay(variant: Variant) -> Any:
        """Repeat a recording, and what the host does behind it."""
        variant.recorder.replay()
        for slot, content in variant.contents:
            whole = slot.get()
            if isinstance(whole, dict):
                whole.clear()
                whole.update(content)
        for slot, value in variant.after:
            slot.set(value)
        return variant.outputs

    def _enter(self, variant: Variant) -> list[Slot]:
        """Bring what slots hold into a recording's memory; return those that hold another kind of thing."""
        unlike = [slot for slot in variant.empty if slot.get() is not None]
        others = [(slot, static, now) for slot, static in variant.before if (now := slot.get()) is not static]
        fits = [is_like(now, static) and id(static) not in variant.shared for _, static, now in others]
        unlike += [slot for (slot, _, _), fit in zip(others, fits, strict=True) if not fit]
        like = [other for other, fit in zip(others, fits, strict=True) if fit]
        bring([(static, now) for _, static, now in like])
        for slot, static, _ in like:
            slot.set(static)
        others_of = [entry for entry in self._entries if entry.variant is not variant]
        entry = None if unlike else self._entry_of(variant)
        self._entries = [*([entry] if entry else []), *others_of][:_MOST_ENTRIES]
        return unlike

    def _entry_of(self, variant: Variant) -> Entry | None:
        """Return what there is, on which a recording depends; None when a part of it is not there."""
        looked_at = self._plain | {slot.name: slot for slot in variant.empty}
        self._memory.settings_of(looked_at)
        self._memory.look()
        moving = [slot for name, slot in looked_at.items() if name in self._memory.moving]
        leaves = []
        for slot, static in variant.before:
            around = slot.around()
            if around is slot or entry_of(around, slot.way[-1], slot) is slot:
                return None
            leaves.append((around, slot.way[-1], static))
        places = places_of([*moving, *(slot.up() for slot, _ in variant.before if len(slot.way) > 1)])
        return None if places is None else Entry(self._memory.version, places, leaves, variant)

    def _run_by_itself(self) -> Any:
        before = [(slot, slot.get()) for slot in slots(self._roots)]
        states = [(stream, stream.get_state()) for stream in self._streams()]
        found = self._work_itself()
        moved = [stream for stream, state in states if not torch.equal(stream.get_state(), state)]
        self._drawn += [stream for stream in moved if not any(stream is known for known in self._drawn)]
        self._memory.let_move([slot.name for slot, value in before if _moves(value, slot.get())])
        for slot, value in before:
            now = slot.get()
            if isinstance(value, torch.Tensor) and isinstance(now, torch.Tensor):
                if now is not value and form_of(now) == form_of(value):
                    self._memory.rebound.add(slot.name)
            elif not isinstance(value, (dict, list)):
                if type(value) in (int, float) and type(now) in (int, float) and now != value:
                    told = Counting(
                        f"'{slot.way[0]}' of {type(slot.holder).__name__} counts, which a recorded step cannot",
                        key="env.sim.graph_step",
                        expected="false, or tensors in the place of numbers that count",
                    )
                    told.found = found
                    raise told
                if isinstance(value, bool) or isinstance(slot.holder, Term) or _kind(now) != _kind(value):
                    self._plain[slot.name] = slot
        return found

    def _try_to_record(self) -> Variant | None:
        """Record the work; None, and a warning once, where it cannot be, as where it waits for the device."""
        for streams in (self._drawn, self._streams()):  # each that is told costs two launches at every replay
            try:
                return self._record(self._recorder(streams))
            except RuntimeError as error:
                reason = str(error).splitlines()[0]
        self._give_up(reason)
        return None

    def _give_up(self, reason: str) -> None:
        self._fails = True
        warnings.warn(f"a part of the step is launched kernel by kernel: {reason}", stacklevel=3)

    def _record(self, recorder: Recorder) -> Variant:
        found = list(slots(self._roots))
        with torch.inference_mode(False), torch.no_grad():
            moved = []
            for slot in found:
                value = slot.get()
                if slot.name in self._memory.rebound and isinstance(value, torch.Tensor):
                    static = self._memory.statics.get(slot.name)
                    if static is None or form_of(static) != form_of(value):
                        static = value.detach().clone()  # its own, whoever has shared it
                        self._memory.statics[slot.name] = static
                    elif static is not value:
                        moved.append((slot, static, value))
                        continue
                    slot.set(static)
            bring([(static, value) for _, static, value in moved])
            for slot, static, _ in moved:
                slot.set(static)
        tensors = [(slot, slot.get()) for slot in found if isinstance(slot.get(), torch.Tensor)]
        others = [(slot, slot.get()) for slot in found if type(slot.get()) in PLAIN]
        wholes = [(slot, dict(slot.get())) for slot in found if isinstance(slot.get(), dict)]
        empty = [slot for slot, value in others if value is None]
        outputs: list[Any] = []
        touched = Touched()

        def work() -> None:
            with touched:
                outputs.append(self._work_and_write_back(tensors))

        try:
            recorder.record(work)
        except Exception:  # nothing was done, and so nothing shall have changed
            for slot, whole in wholes:
                slot.set(whole)
            for slot, value in [*tensors, *others]:
                slot.set(value)
            raise
        contents = [(slot, dict(slot.get())) for slot, was in wholes if _differs(slot.get(), was)]
        after = [(slot, slot.get()) for slot, value in [*tensors, *others] if slot.get() is not value]
        self._memory.let_move([slot.name for slot, value in [*tensors, *others] if _moves(value, slot.get())])
        touched.note((outputs, [value for _, value in after], [whole for _, whole in contents]))  # handed on
        before = [(slot, value) for slot, value in tensors if touched.has(value)]
        return Variant(recorder, before, shared_of(before), empty, after, contents, _standing(outputs[0]))

    def _work_and_write_back(self, tensors: Sequence[tuple[Slot, torch.Tensor]]) -> Any:
        """Do the work, and write what slots hold then into the memory that they held before."""
        result = self._work()
        statics = {static.untyped_storage().data_ptr() for _, static in tensors}
        found = []
        for slot, static in tensors:
            now = slot.get()
            if now is not static and is_like(now, static):
                found.append((slot, static, now.clone() if now.untyped_storage().data_ptr() in statics else now))
        for slot, static, now in found:
            static.copy_(now)
            slot.set(static)
        return result


def _standing(tree: Any) -> Any:
    """Return mappings and sequences of tensors as they are now, whatever becomes of the containers."""
    if isinstance(tree, dict):
        return {key: _standing(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_standing(value) for value in tree)
    return tree


def _moves(value: Any, now: Any) -> bool:
    """Return whether a plain value became another, or something else, or something else a plain value."""
    return now is not value and (type(value) in PLAIN or type(now) in PLAIN)


def _kind(value: Any) -> Any:
    """Return what a recording depends on: a plain value, or what kind of thing there is."""
    return value if type(value) in PLAIN else type(value)


def _differs(now: Any, was: dict[Any, Any]) -> bool:
    return isinstance(now, dict) and (now.keys() != was.keys() or any(now[key] is not was[key] for key in was))
