"""Test that digests change with every bit of a training's state, and with the state only."""

import copy

import pytest
import torch

from wheelleg_exp.rl import checkpoint, digests

STATE = {
    "format_version": 1,
    "iter": 3,
    "infos": None,
    "actor_state_dict": {"w": torch.tensor([[1.0, 2.0], [3.0, 4.0]])},
    "critic_state_dict": {"w": torch.tensor([1.0, -0.0])},
    "rnd_optimizer_state_dict": {"state": {}},
    "optimizer_state_dict": {"state": {0: {"step": torch.tensor(1.0)}}, "param_groups": [{"lr": 1e-3}]},
    "env": {"counter": 5, "streams": {"a": torch.tensor([1], dtype=torch.uint8)}},
    "log": {"returns": [1.0]},
    "rng": {"torch": torch.tensor([2], dtype=torch.uint8)},
    "more": {"x": 1},
}


def changed(change):
    """Return the names of the digests that differ after a change of the state."""
    state = copy.deepcopy(STATE)
    change(state)
    before, after = digests.of_state(STATE), digests.of_state(state)
    return {name for name in {*before, *after} if before.get(name) != after.get(name)}


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda s: s["actor_state_dict"]["w"].__setitem__((1, 0), 3.0000002), "parameters"),
        (lambda s: s["critic_state_dict"]["w"].__setitem__(1, 0.0), "parameters"),
        (lambda s: s["actor_state_dict"].update(w=torch.tensor([1.0, 2.0, 3.0, 4.0])), "parameters"),
        (lambda s: s["critic_state_dict"].update(w=torch.tensor([1.0, -0.0]).double()), "parameters"),
        (lambda s: s["actor_state_dict"].update(v=s["actor_state_dict"].pop("w")), "parameters"),
        (lambda s: s["optimizer_state_dict"]["param_groups"][0].update(lr=2e-3), "optimizer"),
        (lambda s: s["rnd_optimizer_state_dict"].update(state=1), "optimizer"),
        (lambda s: s["env"].update(counter=5.0), "environment"),
        (lambda s: s["env"].update(new=None), "environment"),
        (lambda s: s["env"]["streams"]["a"].__setitem__(0, 3), "streams"),
        (lambda s: s["rng"]["torch"].__setitem__(0, 3), "streams"),
        (lambda s: s["log"]["returns"].append(1.0), "log"),
        (lambda s: s["more"].update(x=2), "rest"),
        (lambda s: s.update(iter=4, infos="x", format_version=2), ""),
    ],
)
def test_a_change_alters_only_the_digest_of_its_part_and_the_name_of_a_checkpoint_alters_no_digest(change, name):
    assert changed(change) == set(name.split())


def test_a_part_moved_from_one_list_to_the_next_is_noticed():
    assert digests.tree_digest([[1], 2]) != digests.tree_digest([[1, 2]])
    assert digests.tree_digest({"a": {"b": 1}, "c": 2}) != digests.tree_digest({"a": {"b": 1, "c": 2}})
    assert digests.tree_digest({"a": "b c"}) != digests.tree_digest({"a b": "c"})


def test_a_saved_and_loaded_state_has_the_same_digests(tmp_path):
    path = tmp_path / "model_3.pt"
    state = {**STATE, "format_version": checkpoint.FORMAT_VERSION}
    path.write_bytes(checkpoint.serialize(state))
    assert digests.of_state(checkpoint.load(path)) == digests.of_state(STATE)


def test_the_layout_in_memory_does_not_change_a_digest():
    w = torch.arange(6.0).reshape(2, 3)
    assert digests.tree_digest(w.T.contiguous().T) == digests.tree_digest(w)
    number = torch.tensor([[1.0, 2.0]])[:, 1]
    assert bytes(digests.tensor_bytes(number)) == bytes(digests.tensor_bytes(torch.tensor([2.0])))
