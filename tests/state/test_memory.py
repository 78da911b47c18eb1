"""Test that tensors with shared memory are found by address and reported by name."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.state import Memory, Stateful


class Holds(Stateful):
    def __init__(self, **items: Any) -> None:
        vars(self).update(items)


WHOLE = torch.arange(6.0).reshape(2, 3)
LIST: list[int] = [0]
APART = {
    "columns": {"a": WHOLE[:, 0], "b": WHOLE[:, 1:]},
    "interleaved": {"a": WHOLE.flatten()[::2], "b": WHOLE.flatten()[1::2]},
    "of the same values": {"a": torch.zeros(2), "b": torch.zeros(2)},
    "expanded": {"a": torch.zeros(1).expand(4), "b": torch.zeros(1)},
    "empty": {"a": WHOLE[:0], "b": WHOLE[:0]},
}
SHARED = {
    "one tensor": {"a": WHOLE, "b": WHOLE},
    "a view": {"a": WHOLE, "b": WHOLE[1, 2:]},
    "views that cross": {"a": WHOLE[0], "b": WHOLE[:, 2]},
    "of other types": {"a": WHOLE, "b": WHOLE.view(torch.int32)},
    "an array's tensor": {"a": (array := np.zeros(3)), "b": torch.from_numpy(array)},
    "in a container": {"a": WHOLE, "b": {"x": (1, [WHOLE[0]])}},
    "one list": {"a": LIST, "b": {"x": LIST}},
    "no numpy type": {"a": (half := torch.zeros(2, dtype=torch.bfloat16)), "b": half[:1]},
}


@pytest.mark.parametrize("items", APART.values(), ids=APART)
def test_attributes_without_shared_memory_are_accepted_until_they_share(items):
    own = Holds(**items)
    memory = Memory({"own": own}, dict)
    memory.require_apart()
    own.a = own.b = torch.zeros(2)
    with pytest.raises(ConfigError, match=r"'[ab]' and '[ab]'"):
        memory.require_apart()


@pytest.mark.parametrize("items", SHARED.values(), ids=SHARED)
def test_sharing_within_an_object_is_refused_with_both_names(items):
    with pytest.raises(ConfigError, match=r"'[ab].*' and '[ab].*'") as caught:
        Memory({"env.rewards.own": Holds(**items)}, dict)
    assert caught.value.key == "env.rewards.own"


def test_a_view_of_foreign_memory_must_exist_from_the_start_to_the_end():
    buffer = torch.zeros(4)
    own = Holds(view=buffer[1:], other=torch.zeros(3))
    memory = Memory({"own": own}, lambda: {"env.buffer": buffer})
    memory.require_apart()
    own.other = buffer[:1]
    with pytest.raises(ConfigError, match=r"'other' has come to share its memory with env\.buffer"):
        memory.require_apart()
    own.other = torch.zeros(3)
    own.view = own.view.clone()
    with pytest.raises(ConfigError, match="'view' no longer shares"):
        memory.require_apart()


def test_the_surroundings_may_share_memory_with_each_other_and_be_replaced():
    tensors, own = {"env.state": WHOLE, "env.view": WHOLE[0]}, Holds(a=torch.zeros(1))
    memory = Memory({"own": own}, lambda: tensors)
    tensors["env.view"] = torch.zeros(3)
    memory.require_apart()
    own.a = tensors["env.view"]
    with pytest.raises(ConfigError, match=r"'a' has come to share its memory with env\.view"):
        memory.require_apart()


def test_two_objects_that_come_to_share_are_both_named():
    one, other = Holds(a=torch.zeros(2)), Holds(b=torch.zeros(2))
    memory = Memory({"one": one, "other": other}, dict)
    other.b = one.a
    with pytest.raises(ConfigError, match=r"'a' has come to share its memory with other\.b") as caught:
        memory.require_apart()
    assert caught.value.key == "one"
