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
from wheelleg_exp.env.slots import Itself, Slot, containers_of_terms, entry_of, is_plain, kept_apart, slots
from wheelleg_exp.env.variants import Entry, Memory, Variant, Variants, bring, form_of, is_like, places_of, shared_of
from wheelleg_exp.errors import ConfigError, SimulationFailure

_MANY = 256  # more runs that begin with values of no recording than with those of one, before it is told
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

    What it decides by plain values of the roots it decides anew for each set of them that a run begins with: each that
    comes up often has a recording of its own. A number that each run changes would stand still in a recording, so it is
    an error; what the roots keep in objects that are not looked into has to stand still as well.

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
        self._variants = Variants()
        self._fails, self._again, self._grown = False, 0, 0

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
                self._variants.missed -= self._variants.missed > 0
                return self._replay(entry.variant)
        if self._grown != self._memory.grown:
            self._look_for_more()
        key = self._key()
        variant = self._variants.get(key)
        if variant is None:
            if not self._variants.is_worth(key):
                self._tell_of(key)
                return self._work_itself()
            found = self._try_to_record()  # which has begun with what is there
            if found is None:
                self._forget()
                return self._work_itself()
            key, variant = found
        elif unlike := self._enter(variant):  # others decide what is there when this begins: recordings depend on it
            self._look_at(unlike)
            if self._again > _MOST_AGAIN:
                slot = unlike[0]
                self._give_up(f"{slot.told} holds other memory again and again")
                return self._work_itself()
            return self()
        self._variants.use(key, variant)
        return self._replay(variant)

    def _key(self) -> tuple[Any, ...]:
        """Return what recordings depend on, as it is now."""
        return tuple(_kind(slot.get()) for slot in self._plain.values())

    def _look_for_more(self) -> None:
        """Let recordings depend on what has come to be in a container since."""
        self._grown = self._memory.grown
        others = [slot for slot in slots(self._roots) if slot.name not in self._plain and is_plain(slot.get())]
        if others and self._variants:
            self._look_at(others)

    def _look_at(self, others: Sequence[Slot]) -> None:
        """Let recordings depend on further places: those that there are did not."""
        self._plain |= {slot.name: slot for slot in others}
        self._variants.clear()
        self._entries.clear()
        self._again += 1

    def _tell_of(self, key: tuple[Any, ...]) -> None:
        """Warn of what changes again and again."""
        if self._variants.missed == _MANY:
            changed = zip(self._plain.values(), key, self._variants.last, strict=True)
            told = next(slot.told for slot, now, was in changed if now != was)
            warnings.warn(
                f"a part of the step is launched kernel by kernel while {told} changes again and again", stacklevel=4
            )

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
        others = [(slot, static, now) for slot, static in variant.before if (now := slot.get()) is not static]
        fits = [is_like(now, static) and id(static) not in variant.shared for _, static, now in others]
        unlike = [slot for (slot, _, _), fit in zip(others, fits, strict=True) if not fit]
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
        self._memory.settings_of(self._plain)
        self._memory.look()
        moving = [slot for name, slot in self._plain.items() if name in self._memory.moving]
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
        apart = kept_apart(self._roots)
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
            elif type(value) in (int, float) and type(now) in (int, float) and now != value:
                told = _counting(
                    f"{slot.told} counts, which a recorded step cannot", "tensors in the place of numbers that count"
                )
                told.found = found
                raise told
            elif not isinstance(value, (dict, list)) and _kind(now) != _kind(value):
                self._plain[slot.name] = slot
        if moved_apart := _differing(apart, kept_apart(self._roots)):
            self._give_up(f"{moved_apart} changes, which is not looked into")
        return found

    def _try_to_record(self) -> tuple[tuple[Any, ...], Variant] | None:
        """Record the work; None, and a warning once, where it cannot be, as where it waits for the device."""
        for streams in (self._drawn, self._streams()):  # each that is told costs two launches at every replay
            try:
                return self._record(self._recorder(streams))
            except (RuntimeError, SimulationFailure) as error:
                if not isinstance(error, RuntimeError) and not isinstance(error.__cause__, RuntimeError):
                    raise
                reason = str(error).splitlines()[0]  # a term's names it
        self._give_up(reason)
        return None

    def _give_up(self, reason: str) -> None:
        self._fails = True
        warnings.warn(f"a part of the step is launched kernel by kernel: {reason}", stacklevel=3)

    def _record(self, recorder: Recorder) -> tuple[tuple[Any, ...], Variant]:
        """Return a recording, and what it depends on."""
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
        others = [(slot, slot.get()) for slot in found if is_plain(slot.get()) or isinstance(slot.get(), tuple)]
        wholes = [(slot, dict(slot.get())) for slot in found if isinstance(slot.get(), dict)]
        if new := [slot for slot, _ in others if slot.name not in self._plain]:
            self._look_at(new)
        self._memory.watch(containers_of_terms(self._roots))
        key, apart = self._key(), kept_apart(self._roots)
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
        if moved_apart := _differing(apart, kept_apart(self._roots)):
            raise _counting(
                f"{moved_apart} has begun to change, which a recorded step cannot follow", "tensors and numbers"
            )
        contents = [(slot, dict(slot.get())) for slot, was in wholes if _differs(slot.get(), was)]
        after = [(slot, slot.get()) for slot, value in [*tensors, *others] if slot.get() is not value]
        self._memory.let_move([slot.name for slot, value in [*tensors, *others] if _moves(value, slot.get())])
        touched.note((outputs, [value for _, value in after], [whole for _, whole in contents]))  # handed on
        before = [(slot, value) for slot, value in tensors if touched.has(value)]
        return key, Variant(recorder, before, shared_of(before), after, contents, _standing(outputs[0]))

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


def _counting(message: str, expected: str) -> Counting:
    return Counting(message, key="env.sim.graph_step", expected=f"false, or {expected}")


def _differing(before: dict[tuple[int, str], Any], now: dict[tuple[int, str], Any]) -> str | None:
    """Return the name of an attribute that is another now."""
    return next((told for name, (told, value) in now.items() if name in before and before[name][1] != value), None)


def _standing(tree: Any) -> Any:
    """Return mappings and sequences of tensors as they are now, whatever becomes of the containers."""
    if isinstance(tree, dict):
        return {key: _standing(value) for key, value in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(_standing(value) for value in tree)
    return tree


def _moves(value: Any, now: Any) -> bool:
    """Return whether a plain value became another, or something else, or something else a plain value."""
    return now is not value and (is_plain(value) or is_plain(now))


def _kind(value: Any) -> Any:
    """Return what a recording depends on: a plain value, a tuple itself, or what kind of thing there is."""
    if is_plain(value):
        return type(value), value
    return Itself(value) if isinstance(value, tuple) else type(value)


def _differs(now: Any, was: dict[Any, Any]) -> bool:
    return isinstance(now, dict) and (now.keys() != was.keys() or any(now[key] is not was[key] for key in was))
