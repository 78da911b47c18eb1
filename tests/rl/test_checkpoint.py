"""Test that checkpoint bytes depend only on the state, and that damaged or malicious files are rejected."""

from __future__ import annotations

import math
import os
import pickle
import random
import warnings
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION, load, serialize


def state(**more):
    return {
        "format_version": FORMAT_VERSION,
        "iter": 7,
        "actor_state_dict": {"weight": torch.arange(6.0).reshape(2, 3)},
        "critic_state_dict": {"weight": torch.ones(3)},
        **more,
    }


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "model_7.pt"
    path.write_bytes(serialize(state()))
    return path


# --- equal states give equal bytes ---


def fresh(text: str) -> str:
    """Return a new string object with equal content."""
    return "".join(list(text))


KEY, ROW, INNER, LARGE = fresh("a key that is not interned"), [1.5, 2.5], {"x": torch.ones(2)}, torch.arange(12.0)
with torch.inference_mode():
    INFERRED = torch.ones(3)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"env": {KEY: 1}, "names": [KEY, KEY]}, {"env": {fresh(KEY): 1}, "names": [fresh(KEY), fresh(KEY)]}),
        ({"a": LARGE, "b": LARGE}, {"a": LARGE.clone(), "b": LARGE.clone()}),
        ({"a": INNER, "b": INNER, "c": ROW, "d": ROW}, {"a": {**INNER}, "b": {**INNER}, "c": [*ROW], "d": [*ROW]}),
        ({"row": LARGE[4:8]}, {"row": torch.tensor([4.0, 5.0, 6.0, 7.0])}),
        ({"column": LARGE[2::4]}, {"column": torch.tensor([2.0, 6.0, 10.0])}),
        ({"x": LARGE[:4].reshape(2, 2).t()}, {"x": torch.tensor([[0.0, 2.0], [1.0, 3.0]])}),
        ({"x": torch.ones(1).expand(5)}, {"x": torch.ones(5)}),
        ({"x": torch.zeros(4, 1).t()}, {"x": torch.zeros(1, 4)}),
        ({"x": torch.nn.Parameter(torch.ones(3))}, {"x": torch.ones(3)}),
        ({"x": INFERRED}, {"x": torch.ones(3)}),
        ({"x": OrderedDict(a=1, b=2)}, {"x": {"a": 1, "b": 2}}),
    ],
)
def test_equal_states_give_the_same_bytes_however_they_lie_in_memory(one, other):
    assert serialize(one) == serialize(other)


@pytest.mark.parametrize(
    "other",
    [
        {"x": torch.tensor([1.0, 2.0000002])},
        {"x": torch.tensor([1.0, 2.0], dtype=torch.float64)},
        {"x": torch.tensor([[1.0, 2.0]])},
        {"y": torch.tensor([1.0, 2.0])},
        {"x": [1.0, 2.0]},
    ],
)
def test_another_state_gives_other_bytes(other):
    assert serialize({"x": torch.tensor([1.0, 2.0])}) != serialize(other)


def test_the_state_itself_is_left_alone():
    tensor = torch.arange(4.0).reshape(2, 2).t()
    held = {"x": tensor, "rows": [tensor]}
    serialize(held)
    assert held["x"] is held["rows"][0] is tensor


# --- reading ---


def test_what_was_written_comes_back(tmp_path):
    more = {"infos": None, "rng": {"torch": torch.get_rng_state()}, "log": {"returns": [1.0, 2.0], "pair": (1, 2)}}
    path = tmp_path / "model_7.pt"
    path.write_bytes(serialize(state(**more)))
    back = load(path)
    assert torch.equal(back["actor_state_dict"]["weight"], torch.arange(6.0).reshape(2, 3))
    assert torch.equal(back["rng"]["torch"], more["rng"]["torch"])
    assert (back["iter"], back["infos"], back["log"]) == (7, None, more["log"])


def check(path: Path, *expected: str) -> None:
    """Check that loading raises an error that names the file and the expected content."""
    with pytest.raises(RunDirectoryError) as caught:
        load(path)
    message = str(caught.value)
    assert str(path) in message
    assert len(message.splitlines()) == 1
    assert "`False`" not in message  # torch's own message suggests an unsafe option.
    assert "weights_only=False" not in message
    assert [text for text in expected if text not in message] == []


FORM = "model_<iteration>.pt"
BYTES = (b"", bytes(100), b"text\n" * 99, b"PK\x03\x04", b"\x80\x02.", b"{}", pickle.dumps({"a": 1}))
WITHOUT = {key: {name: value for name, value in state().items() if name != key} for key in state()}
WRONG = [
    *((content, [FORM]) for content in (*BYTES, torch.nn.Linear(2, 2))),
    *((foreign, [f"lacks '{key}'", FORM]) for key, foreign in WITHOUT.items()),
    (state(averaged_state_dict=3), ["lacks 'averaged_state_dict'"]),
    *((value, ["not a checkpoint of this program"]) for value in ([1, 2], torch.ones(2), "text", None, 3)),
    *(
        (state(format_version=version), [f"version {version}", f"version {FORMAT_VERSION}"])
        for version in (0, FORMAT_VERSION + 1, "1", None)
    ),
]


@pytest.mark.parametrize(("content", "expected"), WRONG)
def test_a_file_that_is_not_a_checkpoint_of_this_version_is_rejected(tmp_path, content, expected):
    path = tmp_path / "model_1.pt"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    check(path, *expected)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_checkpoint_is_rejected(file, share):
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    check(file, "cannot be read", FORM)


def test_a_checkpoint_with_a_flipped_bit_is_read_or_rejected(file):
    data, chance = file.read_bytes(), random.Random(0)
    head = range(data.index(b"data.pkl"), data.index(b"data.pkl") + 500)
    told = 0
    for place in [*head, *(chance.randrange(len(data)) for _ in range(200))]:
        changed = bytearray(data)
        changed[place] ^= 1 << chance.randrange(8)
        file.write_bytes(changed)
        try:
            load(file)
        except RunDirectoryError:
            told += 1
    assert told > 200  # Many changed bits are in tensor data, where no reader detects them.


def test_a_missing_file_a_folder_and_an_exported_policy_are_rejected(tmp_path):
    check(tmp_path / "model_9.pt", "the checkpoint does not exist")
    check(tmp_path, FORM)
    path = tmp_path / "policy.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), path)
    check(path, FORM)


class _Writes:
    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("kind", ["archive", "legacy", "raw"])
def test_code_in_a_checkpoint_is_never_run(tmp_path, kind):
    path, mark = tmp_path / "model_1.pt", tmp_path / "mark"
    value = state(infos=_Writes(mark))
    if kind == "raw":
        path.write_bytes(pickle.dumps({"infos": _Writes(mark)}))
    else:
        torch.save(value, path, _use_new_zipfile_serialization=kind == "archive")
    check(path, FORM)
    assert not mark.exists()
    pickle.loads(pickle.dumps(_Writes(mark)))
    assert mark.exists()  # The code would have created this folder.


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("role", ["actor", "critic", "averaged"])
def test_a_network_that_is_not_finite_is_refused_by_its_parameter_unless_it_is_only_compared(tmp_path, role, bad):
    weight = torch.ones(2, 3)
    weight[1, 2] = bad
    path = tmp_path / "model_7.pt"
    torch.save(state(**{f"{role}_state_dict": {"mlp.0.weight": weight}}), path)
    with pytest.raises(RunDirectoryError, match=f"1 of the 6 numbers of {role}.mlp.0.weight are NaN or inf") as caught:
        load(path)
    assert caught.value.key == str(path)
    assert load(path, finite=False)["iter"] == 7
