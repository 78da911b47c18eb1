"""Test that a captured part returns the same numbers as its Python code, for all kinds of attributes and settings."""

from __future__ import annotations

from collections import deque

import numpy as np
import pytest
import torch

from env.tape import Tape, make_part
from wheelleg_exp.managers.manager_base import Term, TermBase

UNDECLARED = r"runs without a CUDA graph: 'kept[.\w]*' of Keeper changes"


def outputs(run, term: TermBase, name: str, values: list) -> list[float]:
    """Return the results of a captured part for several values of an attribute."""
    found = []
    for value in values:
        setattr(term, name, value)
        found.append(float(run()))
    return found


class Made(TermBase):
    def __init__(self, **attributes: object) -> None:
        vars(self).update(attributes)


class Counter(TermBase):
    def __init__(self) -> None:
        self.count = 0

    def work(self) -> torch.Tensor:
        self.count += 1
        return torch.zeros(()) + self.count


def test_a_term_that_counts_runs_without_a_graph():
    term = Counter()
    part, run = make_part(term.work, term)
    with pytest.warns(UserWarning, match="the part 'work' of the step runs without a CUDA graph: 'count' of Counter c"):
        assert [float(run()) for _ in range(6)] == [1, 2, 3, 4, 5, 6]
    assert part.fails


class Rebinder(TermBase):
    def __init__(self) -> None:
        self.now, self.last = torch.zeros(2), torch.zeros(2)

    def work(self) -> torch.Tensor:
        change = self.now - self.last
        self.last = self.now.clone()
        return change


def test_a_buffer_may_be_rebound():
    term = Rebinder()
    part, run = make_part(term.work, term)
    for step in range(1, 9):
        term.now.fill_(float(step))
        assert run().tolist() == [1.0, 1.0]
    assert len(part.recordings) == 1


def test_a_returned_buffer_is_the_present_one():
    term = Made(now=torch.zeros(2), last=torch.zeros(2))
    _, run = make_part(lambda: (term.last.add_(1.0), term.now)[1], term)
    for step in range(1, 9):
        term.now = torch.full((2,), float(step))
        assert run().tolist() == [step, step]


class Shared(TermBase):
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


@pytest.mark.parametrize("doubles", [(), (2, 7, 8, 9, 10, 11)])
@pytest.mark.parametrize("order", [("now", "last"), ("last", "now")])
def test_buffers_that_share_a_tensor_may_part(order, doubles):
    term = Shared(*order)
    _, run = make_part(term.work, term)
    for step in range(1, 14):
        new = torch.full((2,), float(step * step))
        term.last, term.now = (term.now if step > 4 else new), new
        term.is_double = step in doubles
        expected = (2 * step - 1) * (2 if step in doubles else 1) if step > 4 else 0
        assert run().tolist() == [expected] * 2


def test_buffers_that_share_tensors_of_several_shapes_part():
    term = Made(now=torch.zeros(2), last=torch.zeros(2))

    def work() -> torch.Tensor:
        term.now, term.last = term.now * 2.0, term.last + 1.0
        return term.now - term.last

    _, run = make_part(work, term)
    for step in range(1, 12):
        size = 2 if step % 2 else 3
        term.now = term.last = torch.full((size,), float(step))
        assert run().tolist() == [step - 1.0] * size
        assert (term.now.tolist(), term.last.tolist()) == ([2.0 * step] * size, [step + 1.0] * size)


def test_a_buffer_in_nested_dictionaries_may_get_other_ones():
    term = Made(memory={"a": {"b": torch.zeros(1)}})
    _, run = make_part(lambda: term.memory["a"]["b"] + 0.0, term)
    for step in range(1, 9):
        term.memory = {"a": {"b": torch.full((1,), float(step))}}
        assert float(run()) == step


def test_a_list_of_buffers_that_shrinks_runs_without_a_graph():
    term = Made(memory=[torch.zeros(1) for _ in range(9)])
    _, run = make_part(lambda: term.memory.pop() + 0.0, term)
    with pytest.warns(UserWarning, match="'memory' of Made changes"):
        assert [(float(run()), len(term.memory))[1] for _ in range(8)] == [8, 7, 6, 5, 4, 3, 2, 1]


def test_a_buffer_that_is_seen_through_another_is_not_overwritten():
    memory = torch.arange(20.0)
    term = Made(memory=memory, seen=memory[:4])
    made = []
    _, run = make_part(lambda: term.seen.sum() + 0.0, term, make_graph=lambda streams: made.append(1) or Tape())

    def sum_from(first: int) -> float:
        term.seen = term.memory[first : first + 4]
        return float(run())

    starts = [3 * (step % 5) for step in range(400)]
    with pytest.warns(UserWarning, match="without a CUDA graph: 'seen' of Made changes again and again") as warned:
        sums = [sum_from(first) for first in starts]
    assert sums == [4 * first + 6 for first in starts]
    assert torch.equal(term.memory, torch.arange(20.0))
    assert len(warned) == 1
    assert len(made) < 10


def test_a_part_is_recorded_again_if_a_buffer_gets_other_memory_once():
    memory = torch.arange(20.0)
    term = Made(memory=memory, seen=memory[:4])
    part, run = make_part(lambda: term.seen.sum() + 0.0, term)
    assert [float(run()) for _ in range(5)] == [6.0] * 5
    term.seen = term.memory[3:7]
    assert [float(run()) for _ in range(5)] == [18.0] * 5
    assert len(part.recordings) == 1


def test_a_recording_depends_only_on_buffers_that_the_part_uses():
    term = Made(now=torch.zeros(2), unused=torch.zeros(1))
    part, run = make_part(lambda: term.now + 1.0, term)
    for step in range(8):
        term.now.fill_(float(step))
        term.unused = torch.zeros(step)
        assert run().tolist() == [step + 1.0] * 2
    (recording,) = part.recordings.values()
    assert [slot.label for slot in recording.buffers] == ["'now' of Made"]


def test_a_buffer_may_be_replaced_by_another_tensor_of_any_shape():
    term = Made(now=torch.zeros(2))
    _, run = make_part(lambda: term.now + 1.0, term)
    for step in range(8):
        term.now = torch.full((2,), float(step))
        assert run().tolist() == [step + 1.0] * 2
    for _ in range(6):
        term.now = torch.zeros(3)
        assert run().tolist() == [1.0] * 3
        term.now = torch.zeros(2)
        assert run().tolist() == [1.0] * 2


class Keeper(TermBase):
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
            "list that grows": [last],
        }[kind]

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


@pytest.mark.parametrize("kind", ["deque", "tuple", "tuple in a dictionary", "module", "list that grows"])
def test_a_term_with_undeclared_state_runs_without_a_graph(kind):
    term = Keeper(kind)
    _, run = make_part(term.work, term)
    with pytest.warns(UserWarning, match=UNDECLARED) as warned:
        found = outputs(run, term, "now", [torch.full((1,), float(step)) for step in range(1, 8)])
    assert found == [100 * (step - 1) + step for step in range(1, 8)]
    assert len(warned) == 1


class Scaled(TermBase):
    def __init__(self) -> None:
        self.now, self.scale, self.ranges, self.mode, self.clip = torch.ones(1), 1.0, (0.0, 1.0), "a", None
        self.keeps, self.kept, self.late = False, deque(), np.False_

    def work(self) -> torch.Tensor:
        if self.keeps:
            self.kept.append(1)
        value = self.now * self.scale * self.ranges[1] * (2.0 if self.mode == "b" else 1.0)
        value = value * 7.0 if self.late else value
        return value if self.clip is None else value.clamp(max=self.clip)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [("scale", 3.0, 3.0), ("ranges", (0.0, 5.0), 5.0), ("mode", "b", 2.0), ("clip", 0.5, 0.5), ("late", np.True_, 7.0)],
)
def test_a_setting_of_any_kind_counts_as_soon_as_it_changes(name, value, expected):
    term = Scaled()
    part, run = make_part(term.work, term)
    was = getattr(term, name)
    for step in range(24):
        is_other = step >= 6 and step % 3 != 0
        setattr(term, name, value if is_other else was)
        assert float(run()) == (expected if is_other else 1.0)
    assert len(part.recordings) == 2


def test_a_setting_that_changes_in_each_step_is_named_in_a_warning():
    term = Scaled()
    part, run = make_part(term.work, term)
    with pytest.warns(UserWarning, match="without a CUDA graph: 'scale' of Scaled changes again and again") as warned:
        found = outputs(run, term, "scale", [float(step) for step in range(400)])
    assert found == list(range(400))
    assert len(warned) == 1
    assert not part.recordings
    assert outputs(run, term, "scale", [7.0] * 4) == [7.0] * 4
    assert len(part.recordings) == 1


class Waiter(TermBase):
    def __init__(self) -> None:
        self.now = torch.zeros(1)

    def __call__(self, env: None) -> torch.Tensor:
        return self.now * (2.0 if bool(self.now > 3) else 1.0)


def test_a_term_that_waits_for_the_device_is_named_and_runs_without_a_graph():
    func = Waiter()
    term = Term("asks", "env.rewards.asks", "mine.asks", func)
    _, run = make_part(lambda: term(None), func)
    with pytest.warns(UserWarning, match=r"runs without a CUDA graph: env\.rewards\.asks: 'mine\.asks'"):
        found = outputs(run, func, "now", [torch.full((1,), float(step)) for step in range(1, 8)])
    assert found == [1, 2, 3, 8, 10, 12, 14]


def test_a_term_that_uses_undeclared_state_later_runs_without_a_graph_from_then_on():
    term = Scaled()
    part, run = make_part(term.work, term)
    outputs(run, term, "keeps", [False] * 5)
    assert part.recordings
    with pytest.warns(UserWarning, match="'kept' of Scaled changes"):
        outputs(run, term, "keeps", [True] * 5)
    assert len(term.kept) == 5


@pytest.mark.parametrize("value", [np.float64(3.0), 3])
def test_an_equal_number_of_another_type_is_another_setting(value):
    term = Scaled()
    term.scale, term.now = 3.0, torch.tensor([2])
    _, run = make_part(lambda: term.now * term.scale, term)
    assert outputs(run, term, "scale", [3.0] * 4 + [value] * 6) == [6.0] * 10
    assert run().dtype == (torch.int64 if type(value) is int else torch.float32)


def test_an_entry_that_is_deleted_stays_deleted():
    term = TermBase()
    cache = term.buffer("cache", {})

    def work() -> torch.Tensor:
        cache.pop("old", None)
        return torch.zeros(1)

    part, run = make_part(work, term)
    for _ in range(6):
        cache["old"] = torch.ones(1)
        run()
        assert "old" not in cache
    assert part.recordings


def test_an_entry_that_is_added_is_a_setting():
    term = Scaled()
    term.factors, term.more = [2.0], {}
    part, run = make_part(lambda: term.now * sum(term.factors) * term.more.get("factor", 1.0), term)
    assert [float(run()) for _ in range(5)] == [2.0] * 5
    term.factors.append(3.0)
    assert [float(run()) for _ in range(5)] == [5.0] * 5
    term.more["factor"] = 10.0
    assert [float(run()) for _ in range(5)] == [50.0] * 5
    term.factors = [2.0, 3.0, 1.0]
    assert [float(run()) for _ in range(5)] == [60.0] * 5
    assert not part.fails


def test_more_settings_than_there_is_room_for_are_not_recorded_again_and_again():
    term = Scaled()
    made = []
    _, run = make_part(term.work, term, make_graph=lambda streams: made.append(1) or Tape())
    values = [float(step % 20) for step in range(1200)]
    assert outputs(run, term, "scale", values) == values
    assert len(made) < 40
