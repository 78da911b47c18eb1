"""Objects of a user's own go on from their saved state as they would have gone on."""

from __future__ import annotations

import copy
import io
import itertools
import operator
from collections import OrderedDict, deque
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from env.crawler import Crawl, differing
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.state import Settings, Stateful, made, note_class

NAN, INF = float("nan"), float("inf")


def new(kind, key="env.rewards.own"):
    note_again = note_class(kind)
    value = kind()
    note_again()
    made(value, key)
    return value


def saved(value):
    """Return the state as a checkpoint gives it back."""
    file = io.BytesIO()
    torch.save(value.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def restored(value, lived=0):
    other = new(type(value))
    for k in range(lived):
        other.step(100 + k)
    other.load_state_dict(saved(value))
    return other


# --- equal to the bit ---


class Holds(Stateful):
    settings: ClassVar[tuple[str, ...]] = ("setting",)

    def __init__(self) -> None:
        self.value: Any = None
        self.setting = torch.tensor([NAN, INF, 0.0])


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (np.full(3, NAN), np.zeros(3)),
        (np.array([INF]), np.array([np.finfo(float).max])),
        (np.zeros(2), -np.zeros(2)),
        ([torch.tensor([NAN])], [torch.tensor([0.0])]),
        ([torch.tensor([0.0])], [torch.tensor([-0.0])]),
        (np.float32(NAN), np.float32(0.0)),
        (0.0, -0.0),
        (NAN, 0.0),
        (INF, np.finfo(float).max),
    ],
)
def test_a_value_that_differs_in_one_bit_is_saved(before, after):
    class Kind(Holds):
        def __init__(self) -> None:
            super().__init__()
            self.value = copy.deepcopy(before)

    value = new(Kind)
    value.value = after
    found = restored(value).value
    assert repr(found) == repr(after)
    assert np.asarray(found).tobytes() == np.asarray(after).tobytes()


def test_a_tensor_setting_that_was_no_number_is_saved_once_it_is_one():
    value = new(Holds)
    assert "setting" not in value.state_dict()
    value.setting = torch.tensor([0.0, torch.finfo(torch.float32).max, -0.0])
    assert restored(value).setting.numpy().tobytes() == value.setting.numpy().tobytes()


def test_a_setting_of_a_term_that_was_no_number_is_saved_once_it_is_one():
    params = {"limit": NAN, "offset": 0.0}
    settings = Settings({"params": params}, "env.rewards.own")
    params.update(limit=0.0, offset=-0.0)
    assert settings.state_dict()["params"].keys() == {"limit", "offset"}


# --- what is one thing stays one thing ---


class InContainers(Stateful):
    def __init__(self) -> None:
        self.count = torch.zeros(2)
        self.parts, self.named = [self.count], {"count": self.count}
        self.first, self.wide = self.count[:1], self.count.expand(3, 2)

    def step(self, k):
        self.count += k
        return [self.parts[0], self.named["count"], self.first, self.wide.sum(0)]


class ViewsInLists(Stateful):
    """Only a list keeps what the views look at, and a helper another view."""

    def __init__(self) -> None:
        self.table = torch.arange(6.0).reshape(2, 3)
        self.rows = [*self.table]
        self.helper = Holds()
        self.helper.value = {"column": self.table[:, 1]}

    def step(self, k):
        self.rows[k % 2] += k
        self.helper.value["column"] *= 2
        return [self.table, *self.rows, self.helper.value["column"]]


class ArraysAndTensors(Stateful):
    def __init__(self) -> None:
        self.array = np.zeros(3)
        self.tensor, self.tail, self.again = torch.from_numpy(self.array), self.array[1:], (self.array,)

    def step(self, k):
        self.array[k % 3] += k
        return [self.array, self.tensor, self.tail, self.again[0]]


class Parts(Stateful):
    """One thing at first, two things later."""

    def __init__(self) -> None:
        self.now = self.before = torch.zeros(2)
        self.a = self.b = []
        self.x = self.y = np.zeros(2)

    def step(self, k):
        self.before, self.now = self.now, torch.full((2,), float(k))
        self.a = [*self.a, k]
        self.b.append(-k)
        self.x = self.x + k
        self.y -= k
        return [self.now, self.before, torch.tensor([*self.a, *self.b]), self.x, self.y]


class Meet(Stateful):
    """Two things at first, one thing later."""

    def __init__(self) -> None:
        self.now, self.before, self.other = torch.zeros(2), torch.ones(2), None
        self.a, self.b = [0], [1]
        self.x, self.y = np.zeros(2), np.ones(2)

    def step(self, k):
        self.before += 1
        self.b.append(k)
        self.y += k
        result = [self.now.clone(), self.before.clone(), torch.tensor([*self.a, *self.b]), self.x.copy(), self.y.copy()]
        if k % 3 == 0:
            self.now = self.before = torch.full((2,), float(k))
            self.a = self.b = [k]
            self.x = self.y = np.full(2, float(k))
            self.other = {"now": self.now}
        return result


class TwoBuffers(Stateful):
    """Swaps its buffers and writes into one of them."""

    def __init__(self) -> None:
        self.front, self.back = torch.zeros(2), torch.ones(2)
        self.all = [self.front, self.back]
        self.lists = {"front": [0], "back": [1]}
        self.both = tuple(self.lists.values())

    def step(self, k):
        self.front, self.back = self.back, self.front
        self.lists["front"], self.lists["back"] = self.lists["back"], self.lists["front"]
        self.front += k
        self.lists["front"].append(k)
        lists = [torch.tensor(held) for held in [*self.lists.values(), *self.both]]
        return [self.front, self.back, *self.all, *lists]


class NewViews(Stateful):
    """Looks at another row of its table each time, and at parts of what it makes anew."""

    def __init__(self) -> None:
        self.table, self.row = torch.zeros(3, 2), torch.zeros(2)
        self.state, self.half, self.angles = None, None, None

    def step(self, k):
        if self.half is not None:
            self.half += 1
            self.state *= 2
        self.row += k
        result = [self.table.clone(), self.row.clone(), *([] if self.state is None else [self.state.clone()])]
        self.row = self.table[k % 3]
        if k % 2 == 0:
            self.half = (whole := torch.full((2, 3), float(k)))[:, 1:]
            self.state = whole[:1]
        self.angles = torch.arange(6.0).reshape(2, 3).add(k).unbind(1)
        return [*result, *self.angles]


class Expanded(Stateful):
    def __init__(self) -> None:
        self.wide, self.array = torch.zeros(1).expand(3), torch.ones(2, 1).expand(2, 4)
        self.later = None

    def step(self, k):
        self.wide = (self.wide + k)[:1].expand(3)
        self.later = torch.tensor([float(k)]).expand(2)
        self.array[:, :1].add_(k)
        return [self.wide, self.array, self.later]


class Containers(Stateful):
    """Containers of every kind, some of them remade."""

    def __init__(self) -> None:
        self.last: deque[Any] = deque(maxlen=2)
        self.same, self.seen, self.order = self.last, {0}, OrderedDict(a=torch.zeros(1))
        self.also = self.seen
        self.pair = (self.order["a"], [1])

    def step(self, k):
        self.last.append(torch.tensor([float(k)]))
        self.seen.add(k)
        self.order["a"] += k
        self.pair[1].append(k)
        self.pair = (*self.pair[:2], k)
        return [self.same[0], torch.tensor(sorted(self.also)), self.pair[0], torch.tensor(self.pair[1])]


class EqualForNow(Stateful):
    """Takes another thing of the same value first, and writes into it later."""

    def __init__(self) -> None:
        self.a = self.b = [0]
        self.x = self.y = np.zeros(1)
        self.c = self.d = [1]

    def step(self, k):
        if k == 1:
            self.a, self.x = [0], np.zeros(1)
        if k >= 100:
            self.c = [1]
        self.b.append(k)
        self.y += k
        if k == 9:
            self.c.append(k)
        return [torch.tensor(held) for held in (self.a, self.b, self.c, self.d)] + [self.x.copy(), self.y.copy()]


KINDS = [
    EqualForNow,
    InContainers,
    ViewsInLists,
    ArraysAndTensors,
    Parts,
    Meet,
    TwoBuffers,
    NewViews,
    Expanded,
    Containers,
]


@pytest.mark.parametrize("lived", [0, 3])
@pytest.mark.parametrize("steps", range(8))
@pytest.mark.parametrize("kind", KINDS)
def test_a_restored_object_goes_on_as_the_saved_one(kind, steps, lived):
    value = new(kind)
    for k in range(1, steps + 1):
        value.step(k)
    other = restored(value, lived)
    assert differing(Crawl(value), Crawl(other)) == []
    for k in range(steps + 1, steps + 9):
        a, b = value.step(k), other.step(k)
        assert [np.asarray(x).tobytes() for x in a] == [np.asarray(x).tobytes() for x in b]


def test_what_shares_is_restored_as_the_very_same():
    value = new(InContainers)
    value.step(1)
    other = restored(value)
    assert other.parts[0] is other.count
    assert other.named["count"] is other.count
    assert other.first.data_ptr() == other.count.data_ptr()


@pytest.mark.parametrize(
    "share",
    [
        lambda v: setattr(v, "value", torch.from_numpy(v.array)),
        lambda v: setattr(v, "value", v.array[1:]),
        lambda v: setattr(v, "value", v.setting.view(torch.int32)),
    ],
)
def test_sharing_that_could_not_be_made_again_is_refused_by_both_names(share):
    class Kind(Holds):
        def __init__(self) -> None:
            super().__init__()
            self.array = np.zeros(3)

    value = new(Kind)
    value.array = value.array + 1
    value.state_dict()
    share(value)
    with pytest.raises(ConfigError, match=r"'(value|array|setting)' \(sharing memory with '(value|array|setting)'\)"):
        value.state_dict()


# --- what cannot be seen ---


class _Sized:
    __slots__ = ("__hidden", "_open")

    def __init__(self) -> None:
        self.__hidden, self._open = 0, [0]

    def step(self) -> int:
        self.__hidden += 1
        self._open.append(self.__hidden)
        return self.__hidden


class _Noted(list):
    place = 0


def _noted():
    found = _Noted([1, 2])
    found.place = 1
    return found


UNSEEN = {
    "iter(list)": lambda: iter([1.0, 2.0]),
    "iter(tuple)": lambda: iter((1, 2)),
    "iter(dict)": lambda: iter({1: 2}),
    "iter(range)": lambda: iter(range(3)),
    "map": lambda: map(abs, [1, 2]),
    "filter": lambda: filter(None, [1, 2]),
    "zip": lambda: zip([1], [2], strict=True),
    "enumerate": lambda: enumerate([1]),
    "reversed": lambda: reversed([1, 2]),
    "repeat": lambda: itertools.repeat(1, 3),
    "count": itertools.count,
    "cycle": lambda: itertools.cycle([1]),
    "chain": lambda: itertools.chain([1], [2]),
    "islice": lambda: itertools.islice([1, 2], 2),
    "generator": lambda: (i for i in [1, 2]),
    "callable iterator": lambda: iter(int, 1),
    "dict view": lambda: {1: 2}.keys(),
    "getter": lambda: operator.attrgetter("a"),
    "bytearray": lambda: bytearray(3),
    "file": lambda: io.StringIO("a"),
    "partial": lambda: partial(next, iter([1, 2])),
    "list with attributes": _noted,
    "unfolded tensor": lambda: torch.arange(5.0).unfold(0, 3, 1),
    "sparse tensor": lambda: torch.eye(2).to_sparse(),
}


@pytest.mark.parametrize("inside", [lambda v: v, lambda v: [v], lambda v: {"a": (v,)}])
@pytest.mark.parametrize("make", UNSEEN.values(), ids=UNSEEN.keys())
def test_what_cannot_be_seen_is_refused_by_name_when_it_is_made(make, inside):
    class Kind(Stateful):
        def __init__(self) -> None:
            self.held = inside(make())

    with pytest.raises(ConfigError, match="'held") as caught:
        new(Kind)
    assert caught.value.key == "env.rewards.own"
    assert "cannot be saved" in caught.value.message
    assert "list and the place in it" in str(caught.value.expected)


def test_slots_are_seen_private_ones_too():
    class Kind(Stateful):
        def __init__(self) -> None:
            self.helper, self.mark = _Sized(), object()

        def step(self, k):
            return self.helper.step()

    value = new(Kind)
    value.step(1)
    other = restored(value, lived=4)
    assert [value.step(2), other.step(2)] == [2, 2]
    assert other.helper._open == [0, 1, 2]


# --- the class itself ---


@pytest.mark.parametrize(("before", "after"), [(0, 1), (0.0, -0.0), ("a", "b"), (None, 3), ((1, 2), (1, 3))])
def test_a_class_attribute_that_changes_is_refused_when_saved(before, after):
    class Base(Stateful):
        held: ClassVar[Any] = before

    class Kind(Base):
        pass

    value = new(Kind)
    value.state_dict()
    Base.held = after
    with pytest.raises(ConfigError, match="'held'"):
        value.state_dict()


def test_an_attribute_that_the_class_did_not_have_is_refused_when_saved():
    class Kind(Stateful):
        pass

    class Other(Kind):
        pass

    value = new(Kind)
    Kind.calls = 1
    new(Other)
    with pytest.raises(ConfigError, match="'calls'"):
        value.state_dict()


def test_a_count_of_objects_is_no_state():
    class Kind(Stateful):
        objects: ClassVar[int] = 0

        def __init__(self) -> None:
            type(self).objects += 1

    values = [new(Kind), new(Kind)]
    assert [value.state_dict() for value in values] == [{}, {}]


def test_an_iterator_of_the_class_is_refused_when_an_object_is_made():
    class Kind(Stateful):
        ids: ClassVar[Any] = itertools.count()

    with pytest.raises(ConfigError, match="class attribute 'ids'"):
        new(Kind)
