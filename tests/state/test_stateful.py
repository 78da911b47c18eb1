"""Test that objects with declared state continue from a checkpoint as without an interruption."""

from __future__ import annotations

import copy
import io
import random
from collections import deque
from typing import Any

import numpy as np
import pytest
import torch

from wheelleg_exp.env.undeclared import UndeclaredChanges
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Settings, Stateful, adopt, register_undeclared

NAN, INF = float("nan"), float("inf")


def saved(value):
    """Return the state of an object after it was saved to a checkpoint and loaded."""
    file = io.BytesIO()
    torch.save(value.state_dict(), file)
    file.seek(0)
    return torch.load(file, weights_only=True)


class Declares(Stateful):
    def __init__(self, gain: float = 1.0) -> None:
        self.sum = self.buffer("sum", torch.zeros(3, 2), fill=-1.0)
        self.last: torch.Tensor | None = self.buffer("last", None)
        self.scratch = self.buffer("scratch", torch.zeros(1), saved=False)
        self.calls = self.number("calls", 0)
        self.gain = self.setting("gain", torch.tensor([gain]))
        self.inner = self.child("inner", {"a": Nested()})
        self.view = self.sum[0]

    def step(self, k):
        self.sum += k * self.gain
        self.last = torch.full((2,), float(k)) + (0.0 if self.last is None else self.last)
        self.scratch = torch.full((1,), float(k))
        self.calls += 1
        self.inner["a"].seen.append(k)
        return [self.sum, self.last, torch.tensor([self.calls, *self.inner["a"].seen])]


class Nested(Stateful):
    def __init__(self) -> None:
        self.seen = self.number("seen", [])


class Containers(Stateful):  # declares nothing
    def __init__(self) -> None:
        self.last: list[Any] = []
        self.order = {"a": torch.zeros(1), "b": np.zeros(2), "c": np.float32(0.1)}
        self.pair = (torch.ones(2), [1])
        self.front, self.back = torch.zeros(2), torch.ones(2)

    def step(self, k):
        self.last = [*self.last[-1:], torch.tensor([float(k)])]
        self.order["a"] += k
        self.order["c"] *= np.float32(1.1)
        self.order["b"][k % 2] -= k
        self.pair[1].append(k)
        self.pair = (self.pair[0] * 2, [*self.pair[1]], k)
        self.front, self.back = self.back, self.front
        self.front += k
        numbers = [len(self.last), *self.pair[1]]
        return [self.last[0], *self.order.values(), self.pair[0], self.front, self.back, torch.tensor(numbers)]


class Expanded(Stateful):
    def __init__(self) -> None:
        self.wide = torch.zeros(1).expand(3)

    def step(self, k):
        self.wide = (self.wide + k)[:1].expand(3)
        return [self.wide]


class Generators(Stateful):
    def __init__(self) -> None:
        self.torch = torch.Generator().manual_seed(1)
        self.others = {"second": torch.Generator().manual_seed(2)}

    def step(self, k):
        return [torch.rand(2, generator=self.torch) + torch.rand(2, generator=self.others["second"])]


class Saves:
    def __init__(self) -> None:
        self.total = 0.0

    def state_dict(self):
        return {"total": self.total}

    def load_state_dict(self, saved):
        self.total = saved["total"]


class Helped(Stateful):
    def __init__(self) -> None:
        self.norm, self.memory = torch.nn.BatchNorm1d(1, affine=False), torch.nn.LSTM(1, 1)
        self.own, self.parts = Saves(), Containers()

    @torch.no_grad()
    def step(self, k):
        self.own.total += k
        self.memory.weight_hh_l0 += 0.1
        value = self.norm(torch.arange(float(k + 2)).unsqueeze(1))[:2]
        return [value, self.memory(value)[0], torch.tensor(self.own.total), *self.parts.step(k)]


def new(kind, *args):
    value = kind(*args)
    register_undeclared(value)
    return value


@pytest.mark.parametrize("lived", [0, 3])
@pytest.mark.parametrize("steps", [0, 1, 5])
@pytest.mark.parametrize("kind", [Declares, Containers, Expanded, Generators, Helped])
def test_a_restored_object_continues_like_the_saved_one(kind, steps, lived):
    torch.manual_seed(4)
    value = new(kind)
    for k in range(1, steps + 1):
        value.step(k)
    torch.manual_seed(4)
    other = new(kind)
    for k in range(lived):
        other.step(100 + k)
    other.load_state_dict(saved(value))
    for k in range(steps + 1, steps + 9):
        a, b = value.step(k), other.step(k)
        assert [np.asarray(x).tobytes() for x in a] == [np.asarray(x).tobytes() for x in b]


def test_a_tensor_is_restored_in_place_and_scratch_values_are_not_saved():
    value, other = Declares(), Declares()
    value.step(7)
    other.load_state_dict(saved(value))
    assert other.view.tolist() == [7, 7]
    assert (other.scratch.tolist(), "scratch" in value.state_dict()) == ([0], False)


def test_a_reset_fills_rows():
    value = Declares()
    value.reset_rows(torch.tensor([0, 2]))
    assert value.sum.tolist() == [[-1, -1], [0, 0], [-1, -1]]


class SavesANumber:
    total = 0.0

    def state_dict(self):
        return self.total

    def load_state_dict(self, saved):
        self.total = saved


@pytest.mark.parametrize("made", [lambda part: part, lambda part: [part]])
def test_the_state_of_a_part_can_be_a_number(made):
    value, other = SavesANumber(), SavesANumber()
    value.total = 2.0
    Root(made(other)).load_state_dict(saved(Root(made(value))))
    assert other.total == 2.0


@pytest.mark.parametrize(("before", "after"), [(NAN, 0.0), (INF, 3.0), (0.0, -0.0), (2.0, 2.0)])
def test_a_setting_is_saved_once_one_bit_differs_and_a_new_config_wins_otherwise(before, after):
    value, other = Declares(before), Declares(5.0)
    value.gain.fill_(after)
    other.load_state_dict(saved(value))
    assert repr(float(other.gain)) == repr(5.0 if (before, after) == (2.0, 2.0) else after)


def test_changed_arguments_replace_settings_but_not_state():
    value = Declares(1.0)
    value.step(2)
    adopt(value, Declares(3.0))
    assert (value.gain.tolist(), value.sum[0].tolist(), value.calls, value.view.tolist()) == ([3], [2, 2], 1, [2, 2])


@pytest.mark.parametrize("later", [Saves, torch.Generator, set, random.Random, lambda: iter([1])])
def test_a_value_that_a_new_object_could_not_restore_is_refused(later):
    value = Declares()
    value.calls = later()
    with pytest.raises(ConfigError, match="'calls' of 'Declares'"):
        value.state_dict()


@pytest.mark.parametrize("kind", ["number", "setting"])
def test_a_value_that_no_checkpoint_can_contain_is_refused_when_it_is_declared(kind):
    with pytest.raises(ConfigError, match="'own' of 'Declares' is a value of the type set, which"):
        getattr(Declares(), kind)("own", {1})


def test_changed_settings_are_saved_with_the_value_of_the_config():
    params = {"limit": NAN, "offset": 0.0, "ranges": [1.0, 2.0], "helper": Saves(), "function": len}
    settings = Settings({"params": params}, "env.rewards.own")
    assert settings.state_dict() == {}
    params.update(limit=0.0, offset=-0.0, added=torch.ones(1))
    params["ranges"][1], params["helper"].total = 4.0, 3.0
    state = copy.deepcopy(settings.state_dict())
    assert state["params"].keys() == {"limit", "offset", "ranges", "helper", "added"}
    own = {"limit": NAN, "offset": 0.0, "ranges": [1.0, 3.0], "helper": Saves(), "function": len}
    Settings({"params": own}, "env.rewards.own").load_state_dict(state)
    assert (own["limit"], own["ranges"], own["helper"].total, own["added"].tolist()) == (0.0, [1.0, 3.0], 3.0, [1.0])
    params["seen"] = {1}
    with pytest.raises(ConfigError, match="'seen' has changed"):
        settings.state_dict()
    del params["seen"]
    nested = {"seen": {"a": [{1}]}}
    settings_of_nested = Settings({"params": nested}, "env.rewards.own")
    nested["seen"]["a"][0].add(2)
    for use in (settings_of_nested.state_dict, lambda: settings_of_nested.load_state_dict({})):
        with pytest.raises(ConfigError, match="'seen' has changed to or from a value of the type set"):
            use()
    params["function"] = max
    with pytest.raises(ConfigError, match="'function' has changed"):
        settings.state_dict()


class Root(Stateful):
    def __init__(self, term: object) -> None:
        self.term = self.child("term", term)


SAVEABLE = [
    (torch.zeros(2), lambda value: value.add_(1)),
    (np.zeros(2), lambda value: np.add(value, 1, out=value)),
    ([0], lambda value: value.append(1)),
    (deque([1.0], maxlen=1), lambda value: value.append(2.0)),
    ({"a": torch.zeros(1)}, lambda value: value["a"].add_(1)),
]
UNSAVEABLE = [
    ({1}, lambda value: value.add(2)),
    ({"a": {1}}, lambda value: value["a"].add(2)),
    ([random.Random(1)], lambda value: value[0].random()),
    (np.random.default_rng(1), lambda value: value.random()),
    (np.array(["a"]), lambda value: np.put(value, 0, "b")),
    ({Saves(): 0.0}, lambda value: value.update(a=1.0)),
]


@pytest.mark.parametrize(
    ("value", "change", "in_constructor"),
    [*((*row, False) for row in SAVEABLE), *((*row, True) for row in UNSAVEABLE)],
    ids=lambda value: type(value).__name__,
)
def test_an_undeclared_value_that_changes_is_named(value, change, in_constructor):
    term = Declares()
    term.hidden = copy.deepcopy(value)
    if in_constructor:
        register_undeclared(term)
    watch = UndeclaredChanges(Root(term))
    term.step(1)
    watch.require_none()
    change(term.hidden)
    with pytest.raises(ConfigError, match=r"'hidden' of 'Declares' changes .* not declared") as caught:
        watch.require_none()
    assert "self.buffer" in caught.value.expected or "self.number" in caught.value.expected


def test_a_view_of_a_buffer_may_change_and_a_registered_value_causes_one_note_for_its_class():
    term = new(Containers)
    watch = UndeclaredChanges(Root(term))
    term.step(1)
    with pytest.warns(UserWarning, match="state that the class does not declare") as warned:
        watch.require_none()
    assert len(warned) == 1
