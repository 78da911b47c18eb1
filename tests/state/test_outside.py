"""Test that changes of a term outside its own attributes raise an error that names the change."""

from __future__ import annotations

import copy
import functools
import itertools
from typing import Any, ClassVar

import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import SceneEntityCfg
from wheelleg_exp.state import Outside


def _code(code):
    return Outside({"env.rewards.own": code}, {}, {})


def _counting():
    def term():
        term.calls += 1

    term.calls, term.seen = 0, [1]
    return term


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda f: f(), "calls"),
        (lambda f: f.seen.append(2), "seen"),
        (lambda f: setattr(f, "new", 1), "new"),
        (lambda f: delattr(f, "seen"), "seen"),
    ],
)
def test_a_functions_attributes(change, name):
    term = _counting()
    outside = _code(term)
    outside.require_unchanged()
    change(term)
    with pytest.raises(ConfigError, match=rf"the attribute '{name}' of '.*term'") as caught:
        outside.require_unchanged()
    assert caught.value.key == "env.rewards.own"


def test_a_wrapped_function_is_let_be():
    _code(functools.wraps(_counting())(lambda: None)).require_unchanged()


@pytest.mark.parametrize(("before", "after"), [(0, 1), (0.0, -0.0), ("a", "b"), (None, 3), ((1, 2), (1, 3))])
def test_a_class_attribute_of_a_base(before, after):
    class Base:
        held: ClassVar[Any] = before

    class Kind(Base):
        pass

    outside = _code(Kind)
    outside.require_unchanged()
    Base.held = after
    with pytest.raises(ConfigError, match=r"'held' of '.*Base'"):
        outside.require_unchanged()


def test_a_class_attribute_that_is_changed_in_place_or_new():
    class Kind:
        seen: ClassVar[list[int]] = []

    outside = _code(Kind)
    Kind.seen.append(1)
    with pytest.raises(ConfigError, match="'seen'"):
        outside.require_unchanged()
    outside = _code(Kind)
    Kind.calls = 1
    with pytest.raises(ConfigError, match="'calls'"):
        outside.require_unchanged()


def test_an_iterator_of_a_class_is_refused_at_once():
    class Kind:
        ids: ClassVar[Any] = itertools.count()

    with pytest.raises(ConfigError, match=r"the attribute 'ids' of .*Kind' is a count"):
        _code(Kind)


def _with_default(default):
    def term(env, memory=default, *, rate=1.0):
        pass

    return term


def _of_a_class(default):
    class Kind:
        def __call__(self, env, *, memory=default):
            pass

    return Kind


class _Plain:
    def __init__(self) -> None:
        self.count = 0


@pytest.mark.parametrize("made", [_with_default, _of_a_class, lambda d: functools.wraps(_with_default(d))(lambda: 0)])
@pytest.mark.parametrize(
    ("default", "change"),
    [
        ([], lambda d: d.append(1)),
        ({}, lambda d: d.update(count=1)),
        (torch.zeros(2), lambda d: d.add_(1)),
        (SceneEntityCfg("robot"), lambda d: setattr(d, "stage", 1)),
        (_Plain(), lambda d: setattr(d, "count", 1)),
    ],
)
def test_a_default_argument_that_is_changed_in_place(made, default, change):
    default = copy.deepcopy(default)
    outside = _code(made(default))
    outside.require_unchanged()
    change(default)
    with pytest.raises(ConfigError, match=r"the default argument 'memory' of '.*'"):
        outside.require_unchanged()


def test_an_iterator_as_a_default_argument_is_refused_at_once():
    with pytest.raises(ConfigError, match=r"the default argument 'memory' of .* is a count"):
        _code(_with_default(itertools.count()))


def test_what_init_stores_is_saved_there_and_may_be_a_default_argument():
    class Kind:
        def __init__(self, memory=[]):  # noqa: B006
            self.memory = memory

    outside = _code(Kind)
    Kind().memory.append(1)
    outside.require_unchanged()


class Part:
    __module__ = Outside.__module__
    used = False  # An instance overrides this class attribute later.

    def __init__(self) -> None:
        self._count = 0


class Owner:
    def __init__(self) -> None:
        self.limit, self._count, self.table = 1.0, 0, [0]


def test_an_owner_may_not_get_attributes_nor_have_its_numbers_changed():
    owner = Owner()
    outside = Outside({}, {"env.robot": owner}, {})
    owner._count, owner.table = 5, [1]
    outside.require_unchanged()
    owner.limit = 2.0
    with pytest.raises(ConfigError, match="'limit'") as caught:
        outside.require_unchanged()
    assert caught.value.key == "env.robot"
    owner.limit, owner.mine = 1.0, None
    with pytest.raises(ConfigError, match="'mine'"):
        outside.require_unchanged()


def test_an_attribute_that_appears_below_an_owner_or_on_its_tensor_is_named():
    owner = Owner()
    owner.part, owner.table = Part(), torch.zeros(2)
    outside = Outside({}, {"env.robot": owner}, {})
    owner.table, owner.part._count, owner.part.used = owner.table + 1, 1, True
    outside.require_unchanged()
    owner.table.stage = 1
    with pytest.raises(ConfigError, match="'table'"):
        outside.require_unchanged()
    del owner.table.stage
    owner.part.mine = 1
    with pytest.raises(ConfigError, match="'mine'") as caught:
        outside.require_unchanged()
    assert caught.value.key == "env.robot.part"


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda c: c["rewards"]["alive"].update(weight=2), "env.rewards.alive.weight"),
        (lambda c: c["rewards"]["alive"].update(extra=2), "env.rewards.alive.extra"),
        (lambda c: c["rewards"].pop("alive"), "env.rewards.alive.weight"),
        (lambda c: c["range"].append(2), "env.range[1]"),
    ],
)
def test_a_changed_leaf_of_the_config_is_named_by_its_key(change, key):
    config: dict[str, Any] = {"rewards": {"alive": {"weight": 1}}, "range": [0]}
    outside = Outside({}, {}, config)
    outside.require_unchanged()
    change(config)
    with pytest.raises(ConfigError) as caught:
        outside.require_unchanged()
    assert caught.value.key == key
