"""Checkpoints: bytes that depend on the state alone, and files that cannot hurt."""

from __future__ import annotations

import io
import math
import os
import pickle
import random
import warnings
import zipfile
from collections import OrderedDict
from pathlib import Path

import pytest
import torch

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION, load, serialize


def state(**more):
    return {
        "format_version": FORMAT_VERSION,
        "iter": 7,
        "actor_state_dict": {"weight": torch.arange(6.0).reshape(2, 3)},
        "critic_state_dict": {"weight": torch.ones(3)},
        **more,
    }


def fresh(text: str) -> str:
    """Return an equal text that is another object."""
    return "".join(list(text))


def written(path: Path, value: object) -> Path:
    torch.save(value, path)
    return path


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "model_7.pt"
    path.write_bytes(serialize(state()))
    return path


# --- the same state gives the same bytes ---


def test_shared_and_separate_texts_give_the_same_bytes():
    key = fresh("a key that is not interned")
    shared = {"env": {key: 1}, "optimizer": {key: 2}, "names": [key, key]}
    separate = {"env": {fresh(key): 1}, "optimizer": {fresh(key): 2}, "names": [fresh(key), fresh(key)]}
    assert serialize(shared) == serialize(separate)


def test_shared_and_separate_tensors_give_the_same_bytes():
    tensor = torch.arange(4.0)
    assert serialize({"a": tensor, "b": tensor}) == serialize({"a": tensor.clone(), "b": tensor.clone()})


def test_shared_and_separate_containers_give_the_same_bytes():
    inner, row = {"x": torch.ones(2)}, [1.5, 2.5]
    shared = {"a": inner, "b": inner, "c": row, "d": row}
    separate = {"a": {"x": torch.ones(2)}, "b": {"x": torch.ones(2)}, "c": [1.5, 2.5], "d": [1.5, 2.5]}
    assert serialize(shared) == serialize(separate)


def test_parts_of_a_larger_tensor_give_the_bytes_of_small_ones():
    large = torch.arange(12.0).reshape(3, 4)
    views = {"row": large[1], "column": large[:, 2], "transposed": large.t(), "expanded": torch.ones(1).expand(5)}
    plain = {
        "row": torch.tensor([4.0, 5.0, 6.0, 7.0]),
        "column": torch.tensor([2.0, 6.0, 10.0]),
        "transposed": torch.tensor([[0.0, 4, 8], [1, 5, 9], [2, 6, 10], [3, 7, 11]]),
        "expanded": torch.ones(5),
    }
    assert serialize(views) == serialize(plain)


def test_the_strides_of_an_axis_of_one_do_not_show():
    assert serialize({"x": torch.zeros(4, 1).t()}) == serialize({"x": torch.zeros(1, 4)})


def test_parameters_and_their_values_give_the_same_bytes():
    parameter = torch.nn.Parameter(torch.ones(3))
    with torch.inference_mode():
        inferred = torch.ones(3)
    assert serialize({"x": parameter}) == serialize({"x": inferred}) == serialize({"x": torch.ones(3)})


def test_an_ordered_mapping_is_a_mapping():
    assert serialize({"x": OrderedDict(a=1, b=2)}) == serialize({"x": {"a": 1, "b": 2}})


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
    assert held["x"] is tensor
    assert held["rows"][0] is tensor


# --- reading ---


def test_what_was_written_comes_back(tmp_path):
    more = {"infos": None, "rng": {"torch": torch.get_rng_state()}, "log": {"returns": [1.0, 2.0], "pair": (1, 2)}}
    path = tmp_path / "model_7.pt"
    path.write_bytes(serialize(state(**more)))
    back = load(path)
    assert torch.equal(back["actor_state_dict"]["weight"], torch.arange(6.0).reshape(2, 3))
    assert torch.equal(back["rng"]["torch"], more["rng"]["torch"])
    assert (back["iter"], back["infos"], back["log"]) == (7, None, more["log"])


def test_torch_reads_it_without_running_code(file):
    assert torch.load(file, weights_only=True)["iter"] == 7


def check(path: Path, *expected: str) -> None:
    """The error names the file, and what was expected of it."""
    with pytest.raises(RunDirectoryError) as caught:
        load(path)
    message = str(caught.value)
    assert str(path) in message
    assert len(message.splitlines()) == 1
    assert [text for text in expected if text not in message] == []


def test_a_missing_file_is_told(tmp_path):
    check(tmp_path / "model_9.pt", "the checkpoint does not exist")


def test_a_folder_is_told(tmp_path):
    check(tmp_path, "model_<iteration>.pt")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x00" * 100,
        b"garbage, not a checkpoint\n" * 20,
        b"PK\x03\x04",
        b"\x80\x02.",
        b"{}",
        pickle.dumps({"a": 1}),
    ],
    ids=["empty", "zeros", "text", "head of a zip", "empty pickle", "json", "plain pickle"],
)
def test_a_file_that_is_no_checkpoint_is_told(tmp_path, content):
    path = tmp_path / "model_1.pt"
    path.write_bytes(content)
    check(path, "model_<iteration>.pt")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_truncated_checkpoint_is_told(file, share):
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    check(file, "cannot be read", "model_<iteration>.pt")


def test_a_flipped_byte_is_read_or_told_and_never_anything_else(file):
    """Every byte of the pickled part, and some of the rest, turned over in turn."""
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
    assert told > 200  # of 700: the others are in what no reader looks at, or in numbers


@pytest.mark.parametrize("key", ["format_version", "iter", "actor_state_dict", "critic_state_dict"])
def test_a_checkpoint_of_another_program_is_told(tmp_path, key):
    foreign = {name: value for name, value in state().items() if name != key}
    check(written(tmp_path / "model_1.pt", foreign), f"lacks '{key}'", "model_<iteration>.pt")


@pytest.mark.parametrize("value", [[1, 2], torch.ones(2), "text", None, 3])
def test_a_value_that_is_no_mapping_is_told(tmp_path, value):
    check(written(tmp_path / "model_1.pt", value), "not a checkpoint of this program")


def test_a_whole_network_is_told(tmp_path):
    check(written(tmp_path / "model_1.pt", torch.nn.Linear(2, 2)), "model_<iteration>.pt")


def test_an_exported_policy_is_told(tmp_path):
    path = tmp_path / "policy.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), path)
    check(path, "model_<iteration>.pt")


@pytest.mark.parametrize("kind", ["code", "exported"])
def test_nobody_is_advised_to_switch_the_safety_off(tmp_path, kind):
    path = tmp_path / "model_1.pt"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind == "code":
            torch.save(state(infos=_Writes(tmp_path / "mark")), path)
        else:
            torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), path)
        with pytest.raises(RunDirectoryError) as caught:
            load(path)
    assert "`False`" not in str(caught.value)
    assert "weights_only=False" not in str(caught.value)


@pytest.mark.parametrize("version", [0, FORMAT_VERSION + 1, "1", None])
def test_another_format_version_is_told(tmp_path, version):
    path = written(tmp_path / "model_1.pt", state(format_version=version))
    check(path, f"version {version}", f"version {FORMAT_VERSION}")


class _Writes:
    """Pickled as a call that makes a file."""

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
    check(path, "model_<iteration>.pt")
    assert not mark.exists()


def test_the_mark_of_the_test_above_would_be_made(tmp_path):
    pickle.loads(pickle.dumps(_Writes(tmp_path / "mark")))
    assert (tmp_path / "mark").exists()


def test_the_bytes_are_an_archive_without_the_name_of_a_file():
    with zipfile.ZipFile(io.BytesIO(serialize(state()))) as archive:
        assert {name.split("/")[0] for name in archive.namelist()} == {"archive"}


def test_needed_keys_are_those_that_playing_reads():
    assert set(checkpoint._NEEDED) <= set(state())


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("role", ["actor", "critic", "averaged"])
def test_a_network_that_is_not_finite_is_refused_by_its_parameter_unless_it_is_only_compared(tmp_path, role, bad):
    weight = torch.ones(2, 3)
    weight[1, 2] = bad
    path = written(tmp_path / "model_7.pt", state(**{f"{role}_state_dict": {"mlp.0.weight": weight}}))
    with pytest.raises(RunDirectoryError, match=f"1 of the 6 numbers of {role}.mlp.0.weight are NaN or inf") as caught:
        load(path)
    assert caught.value.key == str(path)
    assert load(path, finite=False)["iter"] == 7
