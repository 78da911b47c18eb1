"""Test that changes of a term outside its own attributes raise an error that names the change."""

from __future__ import annotations

import copy
import functools
import itertools
from typing import Any

import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import SceneEntityCfg
from wheelleg_exp.state import Outside


def _code(code):
    return Outside({"env.rewards.own": code}, {}, {})


def _refused(outside, message=None):
    """Return the key of the error for a change."""
    with pytest.raises(ConfigError, match=message) as caught:
        outside.require_unchanged()
    return caught.value.key


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
def test_a_changed_attribute_of_a_function_is_named(change, name):
    term = _counting()
    outside = _code(term)
    outside.require_unchanged()
    change(term)
    assert _refused(outside, rf"the attribute '{name}' of '.*term'") == "env.rewards.own"


def test_a_wrapped_function_is_accepted_until_an_attribute_changes():
    wrapped = functools.wraps(_counting())(lambda: None)
    outside = _code(wrapped)
    outside.require_unchanged()
    wrapped.__wrapped__()
    assert _refused(outside, "the attribute 'calls'") == "env.rewards.own"


@pytest.mark.parametrize(("before", "after"), [(0, 1), (0.0, -0.0), ("a", "b"), (None, 3), ((1, 2), (1, 3))])
def test_a_changed_class_attribute_of_a_base_is_named(before, after):
    base = type("Base", (), {"held": before})
    outside = _code(type("Kind", (base,), {}))
    outside.require_unchanged()
    base.held = after
    _refused(outside, r"'held' of 'Base'")


def test_a_class_attribute_that_is_changed_in_place_is_named():
    kind = type("Kind", (), {"seen": []})
    outside = _code(kind)
    kind.seen.append(1)
    _refused(outside, "'seen'")


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
def test_a_default_argument_that_is_changed_in_place_is_named(made, default, change):
    default = copy.deepcopy(default)
    outside = _code(made(default))
    outside.require_unchanged()
    change(default)
    _refused(outside, r"the default argument 'memory' of '.*'")


class _Counter:
    calls, seen = 0, torch.zeros(1)  # a plain class of the user, which is not the class of the term


_OBJECT = _Plain()


def _helper():
    return [_Counter for _ in range(1)], _OBJECT


class _Term:
    def __call__(self, env):
        return _helper()


@pytest.mark.parametrize("code", [_Term, _helper, lambda env: _helper()])
@pytest.mark.parametrize(
    ("owner", "name", "change"),
    [
        (_Counter, "calls", lambda: setattr(_Counter, "calls", _Counter.calls + 1)),
        (_Counter, "seen", lambda: _Counter.seen.add_(1)),
        (_Plain, "count", lambda: setattr(_OBJECT, "count", _OBJECT.count + 1)),
    ],
)
def test_a_changed_attribute_of_a_class_or_object_that_the_code_of_a_term_names_is_named(code, owner, name, change):
    outside = _code(code)
    outside.require_unchanged()
    change()
    _refused(outside, f"the attribute '{name}' of '{owner.__qualname__}'")


def test_a_list_in_an_object_that_is_a_class_attribute_is_named():
    kind = type("Kind", (), {"memory": _Plain()})
    kind.memory.seen = []
    outside = _code(kind)
    kind.memory.seen.append(1)
    _refused(outside, "'memory' of 'Kind'")


def test_an_iterator_as_a_class_attribute_or_default_argument_is_refused_at_once():
    kind, term = type("Kind", (), {"ids": itertools.count()}), _with_default(itertools.count())
    for code, what in ((kind, "attribute 'ids' of .*Kind'"), (term, "default argument 'memory' of .*")):
        with pytest.raises(ConfigError, match=f"the {what} is a count"):
            _code(code)


def test_a_default_argument_of_init_may_change_and_a_new_class_attribute_may_not():
    class Kind:
        def __init__(self, memory=[]):  # noqa: B006
            self.memory = memory

    outside = _code(Kind)
    Kind().memory.append(1)  # The state of the object contains the list.
    outside.require_unchanged()
    Kind.calls = 1
    _refused(outside, "'calls'")


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
    assert _refused(outside, "'limit'") == "env.robot"
    owner.limit, owner.mine = 1.0, None
    _refused(outside, "'mine'")


def test_an_attribute_that_appears_below_an_owner_or_on_its_tensor_is_named():
    owner = Owner()
    owner.part, owner.table = Part(), torch.zeros(2)
    outside = Outside({}, {"env.robot": owner}, {})
    owner.table, owner.part._count, owner.part.used = owner.table + 1, 1, True
    outside.require_unchanged()
    owner.table.stage = 1
    _refused(outside, "'table'")
    del owner.table.stage
    owner.part.mine = 1
    assert _refused(outside, "'mine'") == "env.robot.part"


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
    assert _refused(outside) == key
