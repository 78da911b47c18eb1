"""A part that is recorded does what it does by itself, whatever its terms keep and whoever changes their settings."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
import torch

from env.taping import Tape
from wheelleg_exp.env.captured import Captured, Counting
from wheelleg_exp.env.variants import Memory
from wheelleg_exp.managers.manager_base import Term, TermBase


class Counts:
    """Something that counts its steps."""

    __module__ = "wheelleg_exp.fake"

    def __init__(self) -> None:
        self.count = 0

    def work(self) -> None:
        self.count += 1


def test_what_counts_is_refused_with_what_to_set():
    counts = Counts()
    with pytest.raises(Counting, match="'count' of Counts counts, which a recorded step cannot") as told:
        Captured(counts.work, [counts], Tape, lambda: None)()
    assert told.value.key == "env.sim.graph_step"


class Remembers(TermBase):
    """A user's term, of a package of theirs: it lets an attribute hold another tensor at each step."""

    def __init__(self) -> None:
        self.now, self.last = torch.zeros(2), torch.zeros(2)

    def work(self) -> torch.Tensor:
        change = self.now - self.last
        self.last = self.now.clone()
        return change


class HandsOn(Remembers):
    """A user's term that hands on a tensor as it is."""

    def work(self) -> torch.Tensor:
        self.last += 1.0
        return self.now


def test_a_tensor_that_is_handed_on_is_that_of_now():
    term = HandsOn()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 7):
        term.now = torch.full((2,), float(step))
        assert part().tolist() == [step, step]


def test_what_a_term_of_a_users_own_remembers_goes_on():
    term = Remembers()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 7):
        term.now.fill_(float(step))
        assert part().tolist() == [1.0, 1.0]


class Differs(TermBase):
    """Compares two attributes that a user sets between the steps."""

    def __init__(self) -> None:
        self.now, self.last = torch.zeros(2), torch.zeros(2)

    def work(self) -> torch.Tensor:
        return self.now - self.last


@pytest.mark.parametrize("order", [("now", "last"), ("last", "now")])
def test_a_tensor_that_is_passed_on_between_two_attributes_keeps_its_numbers(order):
    term = Differs()
    values = vars(term)
    term.__dict__ = {name: values[name] for name in order}  # the order in which they are brought into memory
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 8):
        term.last = term.now
        term.now = torch.full((2,), float(step * step))
        assert part().tolist() == [2 * step - 1] * 2


class Parts(TermBase):
    """As a user's term whose attributes are one tensor at first, and its own."""

    def __init__(self, *order: str) -> None:
        one = torch.zeros(2)
        for name in order:
            setattr(self, name, one)
        self.is_double = False

    def work(self) -> torch.Tensor:
        change = (self.now - self.last) * (2.0 if self.is_double else 1.0)
        if self.is_double:
            self.now, self.last = self.now + 0.0, self.last + 0.0
        return change


@pytest.mark.parametrize("doubles", [(), (2, 7, 8, 9)])
@pytest.mark.parametrize("order", [("now", "last"), ("last", "now")])
def test_attributes_that_were_one_tensor_may_part(order, doubles):
    """Also where a second recording is made behind a value that was passed on."""
    term = Parts(*order)
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(1, 12):
        new = torch.full((2,), float(step * step))
        term.last, term.now = (term.now if step > 4 else new), new
        term.is_double = step in doubles
        expected = (2 * step - 1) * (2 if step in doubles else 1) if step > 4 else 0
        assert part().tolist() == [expected] * 2


class Looks(TermBase):
    """A user's term that looks at a part of its own memory, set between the steps."""

    def __init__(self) -> None:
        self.memory = torch.arange(20.0)
        self.seen = self.memory[:4]

    def work(self) -> torch.Tensor:
        return self.seen.sum() + 0.0


@pytest.mark.filterwarnings("ignore:a part of the step is launched kernel by kernel")
def test_what_is_seen_through_an_attribute_is_not_overwritten():
    term = Looks()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(80):  # so often that it is given up
        first = 3 * (step % 5)
        term.seen = term.memory[first : first + 4]
        assert float(part()) == 4 * first + 6
        assert torch.equal(term.memory, torch.arange(20.0))
    assert part._fails


class Waits(TermBase):
    """Reads a tensor, and holds another that each step replaces by one of another shape."""

    def __init__(self) -> None:
        self.now, self.beside = torch.zeros(2), torch.zeros(1)

    def work(self) -> torch.Tensor:
        return self.now + 1.0


def test_what_a_part_does_not_read_may_take_any_shape_and_the_recording_stays():
    term = Waits()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(8):
        term.now.fill_(float(step))
        term.beside = torch.zeros(step)
        assert part().tolist() == [step + 1.0] * 2
        made = part._variants
    variant = next(iter(made._known.values()))
    term.beside = torch.zeros(9)
    part()
    assert list(part._variants._known.values()) == [variant]
    assert [slot.way for slot, _ in variant.before] == [("now",)]


def test_another_tensor_in_the_place_of_one_that_a_part_reads_is_brought_into_its_memory():
    term = Waits()
    part = Captured(term.work, [term], Tape, lambda: None)
    for step in range(8):
        term.now = torch.full((2,), float(step))
        assert part().tolist() == [step + 1.0] * 2
    term.now = torch.zeros(3)
    assert part().tolist() == [1.0] * 3


def run(part: Captured, term: TermBase, name: str, values: list) -> list[float]:
    """Return what a part returns with one value of an attribute after the other."""
    found = []
    for value in values:
        setattr(term, name, value)
        found.append(float(part()))
    return found


class Kept(TermBase):
    """A user's term that keeps what it saw last in some kind of container."""

    def __init__(self, kind: str) -> None:
        self.now, self.kind = torch.zeros(1), kind
        last = torch.zeros(1)
        module = torch.nn.Module()
        module.register_buffer("last", last)
        self.kept = {
            "deque": deque([last], maxlen=1),
            "tuple": (last,),
            "tuple in a dictionary": {"last": (last,)},
            "module": module,
            "object": type("Object", (), {})(),
            "list that grows": [last],
        }[kind]
        if kind == "object":
            self.kept.last = last

    def work(self) -> torch.Tensor:
        now = self.now.clone()
        if self.kind in ("deque", "list that grows"):
            was = self.kept[-1]
            self.kept.append(now)
        elif self.kind == "tuple":
            (was,) = self.kept
            self.kept = (now,)
        elif self.kind == "tuple in a dictionary":
            (was,) = self.kept["last"]
            self.kept["last"] = (now,)
        else:
            was, self.kept.last = self.kept.last, now
        return 100 * was + self.now


@pytest.mark.parametrize("kind", ["deque", "tuple", "tuple in a dictionary", "module", "object", "list that grows"])
def test_what_a_term_keeps_where_nobody_looks_is_not_recorded(kind):
    term = Kept(kind)
    part = Captured(term.work, [term], Tape, lambda: None)
    with pytest.warns(UserWarning, match="kernel by kernel: 'kept' of Kept changes, which is not") as told:
        found = run(part, term, "now", [torch.full((1,), float(step)) for step in range(1, 8)])
    assert found == [100 * (step - 1) + step for step in range(1, 8)]
    assert len(told) == 1


class Scaled(TermBase):
    """Reads settings of many kinds."""

    def __init__(self) -> None:
        self.now, self.scale, self.ranges, self.mode, self.clip = torch.ones(1), 1.0, (0.0, 1.0), "a", None
        self.width = 1.0  # as something of this program's own is called that stands still
        self.keeps = False

    def work(self) -> torch.Tensor:
        if self.keeps:
            self.kept.append(1)
        value = self.now * self.scale * self.ranges[1] * self.width * (2.0 if self.mode == "b" else 1.0)
        return value if self.clip is None else value.clamp(max=self.clip)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("scale", 3.0, 3.0), ("width", 4.0, 4.0), ("ranges", (0.0, 5.0), 5.0), ("mode", "b", 2.0), ("clip", 0.5, 0.5)],
)
def test_a_setting_of_any_kind_that_somebody_changes_between_steps_counts_as_it_is(name, value, expected):
    term = Scaled()
    part = Captured(term.work, [term], Tape, lambda: None)
    was = getattr(term, name)
    for step in range(24):
        is_other = step >= 6 and step % 3 != 0  # and back again
        setattr(term, name, value if is_other else was)
        assert float(part()) == (expected if is_other else 1.0)
    assert len(part._variants) == 2


def test_settings_that_change_again_and_again_are_told_of_and_what_stands_still_is_recorded():
    term = Scaled()
    part = Captured(term.work, [term], Tape, lambda: None)
    with pytest.warns(UserWarning, match="kernel by kernel while 'scale' of Scaled changes again and again") as told:
        found = run(part, term, "scale", [float(step) for step in range(400)])
    assert found == list(range(400))
    assert len(told) == 1
    assert len(part._variants) == 1
    for _ in range(4):
        assert float(part()) == 399
    assert len(part._variants) == 2


class Asks(TermBase):
    """Waits for a number, as a graph cannot."""

    def __init__(self) -> None:
        self.now = torch.zeros(1)

    def __call__(self, env: None) -> torch.Tensor:
        return self.now * (2.0 if bool(self.now > 3) else 1.0)


def test_a_term_that_waits_is_launched_kernel_by_kernel_and_named():
    func = Asks()
    term = Term("asks", "env.rewards.asks", "mine.asks", func)
    part = Captured(lambda: term(None), [func], Tape, lambda: None)
    with pytest.warns(UserWarning, match=r"kernel by kernel: env\.rewards\.asks: 'mine\.asks'"):
        found = run(part, func, "now", [torch.full((1,), float(step)) for step in range(1, 8)])
    assert found == [1, 2, 3, 8, 10, 12, 14]


def test_what_begins_to_be_kept_there_later_is_an_error_with_what_to_set():
    term = Scaled()
    term.kept, term.keeps = deque(), False
    part = Captured(term.work, [term], Tape, lambda: None)
    run(part, term, "keeps", [False] * 5)
    with pytest.raises(Counting, match="'kept' of Scaled has begun to change") as told:
        run(part, term, "keeps", [True] * 5)
    assert told.value.key == "env.sim.graph_step"


class Hands(TermBase):
    """Keeps a tuple that one part replaces and another reads."""

    def __init__(self) -> None:
        self.now, self.kept = torch.zeros(1), (torch.zeros(1),)

    def take(self) -> torch.Tensor:
        self.kept = (self.now.clone(),)
        return self.now + 0.0

    def read(self) -> torch.Tensor:
        return self.kept[0] + 0.0


@pytest.mark.filterwarnings("ignore:a part of the step is launched kernel by kernel")
def test_a_tuple_that_another_part_replaces_is_read_as_it_is():
    term, memory = Hands(), Memory()
    take, read = (Captured(work, [term], Tape, lambda: None, memory=memory) for work in (term.take, term.read))
    for step in range(1, 12):
        term.now.fill_(float(step))
        assert float(read()) == step - 1
        assert float(take()) == step


@pytest.mark.parametrize("value", [np.float64(3.0), 3])
def test_a_number_of_another_kind_is_another_setting(value):
    term = Scaled()
    term.scale, term.now = 3.0, torch.tensor([2])
    part = Captured(lambda: term.now * term.scale, [term], Tape, lambda: None)
    assert run(part, term, "scale", [3.0] * 4 + [value] * 6) == [6.0] * 10
    assert part().dtype == (torch.int64 if type(value) is int else torch.float32)


def test_what_is_added_to_the_settings_counts():
    term = Scaled()
    term.factors, term.more = [2.0], {}
    part = Captured(
        lambda: term.now * sum(term.factors) * term.more.get("factor", 1.0) * getattr(term, "late", 1.0),
        [term],
        Tape,
        lambda: None,
    )
    assert [float(part()) for _ in range(5)] == [2.0] * 5
    term.factors.append(3.0)
    assert [float(part()) for _ in range(5)] == [5.0] * 5
    term.more["factor"] = 10.0
    assert [float(part()) for _ in range(5)] == [50.0] * 5
    term.late = 0.5
    assert [float(part()) for _ in range(5)] == [25.0] * 5
    term.factors = [2.0, 3.0, 1.0]  # another list that begins as the one did
    assert [float(part()) for _ in range(5)] == [30.0] * 5
    assert not part._fails


def test_more_settings_in_turn_than_there_is_room_for_do_not_record_without_end():
    term = Scaled()
    made = []
    part = Captured(term.work, [term], lambda streams: made.append(1) or Tape(), lambda: None)
    values = [float(step % 20) for step in range(1200)]
    with pytest.warns(UserWarning, match="while 'scale' of Scaled changes again and again"):
        assert run(part, term, "scale", values) == values
    assert len(made) < 40
