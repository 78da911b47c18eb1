"""Test that user-defined objects continue from their saved state as without an interruption."""

from __future__ import annotations

import copy
import io
import itertools
import operator
import random
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Settings, Stateful, made

NAN, INF = float("nan"), float("inf")


def new(kind, key="env.rewards.own"):
    value = kind()
    made(value, key)
    return value


def saved(value):
    """Return the state of an object after it was saved to a checkpoint and loaded."""
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


# --- bit-exact comparison ---


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


def test_a_setting_that_was_nan_or_inf_is_saved_once_it_is_finite():
    value = new(Holds)
    assert "setting" not in value.state_dict()
    value.setting = torch.tensor([0.0, torch.finfo(torch.float32).max, -0.0])
    assert restored(value).setting.numpy().tobytes() == value.setting.numpy().tobytes()
    params = {"limit": NAN, "offset": 0.0}
    settings = Settings({"params": params}, "env.rewards.own")
    params.update(limit=0.0, offset=-0.0)
    assert settings.state_dict()["params"].keys() == {"limit", "offset"}


def test_a_settings_own_state_goes_round_and_is_not_put_on_another_setting():
    def fresh(total):
        helper = Saves()
        helper.total = total
        return helper, Settings({"params": {"helper": helper}}, "env.rewards.own")

    helper, settings = fresh(0.0)
    helper.total = 3.0
    state = settings.state_dict()
    other, others = fresh(0.0)
    others.load_state_dict(state)
    another, anothers = fresh(1.0)
    anothers.load_state_dict(state)
    assert (other.total, another.total) == (3.0, 1.0)


# --- state that can be saved ---


class Containers(Stateful):
    def __init__(self) -> None:
        self.last: deque[Any] = deque(maxlen=2)
        self.seen, self.order = {0}, {"a": torch.zeros(1), "b": np.zeros(2)}
        self.pair, self.mode = (torch.ones(2), [1]), frozenset({"a"})

    def step(self, k):
        self.last.append(torch.tensor([float(k)]))
        self.seen.add(k)
        self.order["a"] += k
        self.order["b"][k % 2] -= k
        self.pair[1].append(k)
        self.pair = (self.pair[0] * 2, [*self.pair[1]], k)
        self.mode |= {str(k)}
        numbers = [len(self.seen), len(self.last), len(self.mode), *self.pair[1]]
        return [self.last[0], self.order["a"], self.order["b"], self.pair[0], torch.tensor(numbers)]


class Expanded(Stateful):
    def __init__(self) -> None:
        self.wide, self.later = torch.zeros(1).expand(3), None

    def step(self, k):
        self.wide = (self.wide + k)[:1].expand(3)
        self.later = torch.tensor([float(k)]).expand(2)
        return [self.wide, self.later]


class Swapped(Stateful):
    def __init__(self) -> None:
        self.front, self.back = torch.zeros(2), torch.ones(2)
        self.lists = {"front": [0], "back": [1]}

    def step(self, k):
        self.front, self.back = self.back, self.front
        self.lists["front"], self.lists["back"] = self.lists["back"], self.lists["front"]
        self.front += k
        self.lists["front"].append(k)
        return [self.front, self.back, *map(torch.tensor, self.lists.values())]


class Generators(Stateful):
    def __init__(self) -> None:
        self.torch = torch.Generator().manual_seed(1)
        self.others = {"python": random.Random(2), "numpy": np.random.default_rng(3)}

    def step(self, k):
        drawn = self.others["python"].random() + self.others["numpy"].random()
        return [torch.rand(2, generator=self.torch) + drawn]


class Saves:
    def __init__(self) -> None:
        self.total, self.seen = 0.0, iter([])

    def state_dict(self):
        return {"total": self.total}

    def load_state_dict(self, saved):
        self.total = saved["total"]


class Helped(Stateful):
    def __init__(self) -> None:
        self.norm, self.memory = torch.nn.BatchNorm1d(1, affine=False), torch.nn.LSTM(1, 1)
        self.own, self.parts = Saves(), [Swapped()]

    @torch.no_grad()
    def step(self, k):
        self.own.total += k
        self.memory.weight_hh_l0 += 0.1
        value = self.norm(torch.arange(float(k + 2)).unsqueeze(1))[:2]
        return [value, self.memory(value)[0], torch.tensor(self.own.total), *self.parts[0].step(k)]


KINDS = [Containers, Expanded, Swapped, Generators, Helped]


@pytest.mark.parametrize("lived", [0, 3])
@pytest.mark.parametrize("steps", [0, 1, 2, 5])
@pytest.mark.parametrize("kind", KINDS)
def test_a_restored_object_continues_like_the_saved_one(kind, steps, lived):
    torch.manual_seed(4)
    value = new(kind)
    for k in range(1, steps + 1):
        value.step(k)
    torch.manual_seed(4)
    other = restored(value, lived)
    for k in range(steps + 1, steps + 9):
        a, b = value.step(k), other.step(k)
        assert [np.asarray(x).tobytes() for x in a] == [np.asarray(x).tobytes() for x in b]


def test_a_tensor_is_restored_in_place_so_that_its_views_see_it():
    value, other = new(Swapped), new(Swapped)
    looking = other.front
    value.front += 7
    other.load_state_dict(saved(value))
    assert looking.tolist() == [7, 7]


# --- state that cannot be saved ---


def holding(make):
    """Return a class with one attribute, ``held``."""

    class Kind(Stateful):
        def __init__(self) -> None:
            self.held = make()

    return Kind


@dataclass
class Choice:
    names: list[str]


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda n: setattr(n, "calls", 1), "calls"),
        (lambda n: n.history.append(1), "history"),
        (lambda n: n.hidden.add_(1), "hidden"),
        (lambda n: n.train(False), "training"),
        (lambda n: setattr(n, "new", 1), "new"),
    ],
)
def test_a_changing_value_outside_the_state_dict_of_a_network_is_rejected(change, name):
    class Kind(Stateful):
        def __init__(self) -> None:
            self.network = torch.nn.BatchNorm1d(1, affine=False)
            self.network.calls, self.network.history = 0, [0]
            self.network.register_buffer("hidden", torch.zeros(1), persistent=False)

    value = new(Kind)
    value.state_dict()
    change(value.network)
    with pytest.raises(ConfigError, match=rf"network\.{name}'.*register a buffer"):
        value.state_dict()


def test_a_dataclass_may_be_an_attribute_but_must_not_change():
    value = new(holding(lambda: Choice(["a"])))
    assert value.state_dict() == {}
    value.held.names.append("b")
    with pytest.raises(ConfigError, match=r"'held'.*changed"):
        value.state_dict()


class Tagged(list):
    """A subclass of list, whose instances can have attributes."""


class Sized:
    __slots__ = ("held",)


class Helper:
    pass


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
    "list of a class of its own": Tagged,
    "object of any class": Helper,
    "object with slots": Sized,
    "config": lambda: OmegaConf.create({"a": 1}),
    "simulation": lambda: mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")),
    "method of such an object": lambda: Helper().__str__,
    "sparse tensor": lambda: torch.eye(2).to_sparse(),
}


@pytest.mark.parametrize("inside", [lambda v: v, lambda v: [v], lambda v: {"a": (v,)}])
@pytest.mark.parametrize("make", UNSEEN.values(), ids=UNSEEN.keys())
def test_what_cannot_be_seen_is_refused_by_name_when_it_is_made(make, inside):
    with pytest.raises(ConfigError, match="'held") as caught:
        new(holding(lambda: inside(make())))
    assert caught.value.key == "env.rewards.own"
    assert "cannot be saved" in caught.value.message
    assert "list and the place in it" in str(caught.value.expected)


@pytest.mark.parametrize("later", [random.Random, Saves, lambda: torch.Generator()])
def test_a_later_object_that_only_its_owner_can_create_is_rejected(later):
    value = new(Holds)
    value.value = later()
    with pytest.raises(ConfigError, match=r"'value'.*added after"):
        value.state_dict()


def test_an_attribute_that_is_deleted_or_in_slots_is_refused():
    value = new(Swapped)
    del value.front
    with pytest.raises(ConfigError, match="'front'"):
        value.state_dict()
    with pytest.raises(ConfigError, match="__slots__"):
        new(type("Kind", (Stateful,), {"__slots__": ("_open",)}))


def test_an_object_that_points_back_at_itself_is_refused():
    circle: list[Any] = []
    circle.append(circle)
    with pytest.raises(ConfigError, match="points back at itself"):
        new(holding(lambda: circle))
