"""Compare checkpoints tensor by tensor, and exported policies by their weights, code, and graphs."""

from __future__ import annotations

import filecmp
import math
import pickletools
import re
import zipfile
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import for_people, read_bytes, read_json
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.run.run_directory import RunDirectory, checkpoint_iteration
from wheelleg_exp.run.source_changes import first_few
from wheelleg_exp.verify.run_differences import plain_changes
from wheelleg_exp.verify.run_parts import Part

if TYPE_CHECKING:
    from wheelleg_exp.verify.tensor_differences import Difference

_MOST_LEAVES = 50  # A comparison of two checkpoints stores at most 50 differences.


@dataclass(frozen=True)
class Pair:
    """The comparison of the checkpoints that two runs saved at one iteration."""

    iteration: int
    # The state ``content`` means that two checkpoint files contain equal tensors, but different bytes.
    state: Literal["bytes", "content", "different", "unreadable"]
    count: int = 0  # The number of tensors, numbers, and texts that differ between two checkpoints.
    of: int = 0
    differences: list[Difference] = field(default_factory=list)  # Differences of network weights are listed first.
    by_part: dict[str, int] = field(default_factory=dict)  # Count differences in each part, such as the actor network.
    parameters: float | None = None  # The relative Euclidean distance between the parameters of two networks.
    problem: str | None = None  # The reason why a checkpoint file cannot be read.

    @property
    def equal(self) -> bool:
        """True if all numbers of the two checkpoints are equal bit for bit."""
        return self.state in ("bytes", "content")


@dataclass(frozen=True)
class CheckpointComparison:
    """The compared checkpoints of two runs, and the iterations at which only one run saved a checkpoint."""

    pairs: list[Pair]
    only_a: list[int]
    only_b: list[int]


def compare_checkpoints(a: RunDirectory, b: RunDirectory, until: int) -> CheckpointComparison:
    """Compare the checkpoints that two runs saved at the same iterations, up to the iteration ``until - 1``."""
    ones, others = ({checkpoint_iteration(path): path for path in run.checkpoints()} for run in (a, b))
    return CheckpointComparison(
        pairs=[compare_pair(i, ones[i], others[i]) for i in sorted(i for i in ones if i in others and i < until)],
        only_a=sorted(i for i in ones if i not in others and i < until),
        only_b=sorted(i for i in others if i not in ones and i < until),
    )


def compare_pair(iteration: int, a: Path, b: Path) -> Pair:
    """Compare two checkpoint files. If the bytes of two checkpoint files are equal, do not load these files."""
    try:
        with for_people(a, "compare"):
            if filecmp.cmp(a, b, shallow=False):
                return Pair(iteration, "bytes")
        from wheelleg_exp.rl import checkpoint
        from wheelleg_exp.verify import tensor_differences

        one, other = (checkpoint.load(path, finite=False) for path in (a, b))  # ``finite=False`` accepts NaN.
        found = list(tensor_differences.tree_differences(one, other))
        of = tensor_differences.count_leaves(one)
        if not found:
            return Pair(iteration, "content", of=of)
        found.sort(key=_order)
        networks = map(tensor_differences.network_tensors, (one, other))
        distance = tensor_differences.relative_distance(*networks)
        parts = Counter(_part(difference.name) for difference in found)
        return Pair(iteration, "different", len(found), of, found[:_MOST_LEAVES], dict(parts), distance)
    except RunDirectoryError as error:
        return Pair(iteration, "unreadable", problem=str(error))


def _part(name: str) -> str:
    return "env.streams" if name.startswith("env.streams") else name.split(".")[0].split("[")[0]


def _order(difference: Difference) -> tuple[int, float]:
    """Return the sort key of a difference: by part of the checkpoint, then by size."""
    # Within a part such as the actor, list missing or reshaped tensors first, then NaN, then the largest differences.
    order = ("actor_state_dict", "critic_state_dict", "student_state_dict", "env", "optimizer_state_dict")
    part = _part(difference.name)
    rank = order.index(part) if part in order else len(order) + (part in ("env.streams", "rng"))
    if difference.kind != "values" or difference.relative is None:
        return rank, -3.0
    # A relative difference is at most 2, so 2.5 sorts NaN before all finite differences.
    return rank, -2.5 if math.isnan(difference.relative) else -difference.relative


_EQUAL, _EQUAL_CONTENT = "equal", "weights and code equal, other bytes"
_NUMBER, _NUMBER_IN_PATH = re.compile(r"\.___torch_mangle_\d+"), re.compile(r"/___torch_mangle_\d+(?=[./])")
_CONSTANTS = re.compile(r"(?:^  \w+ : Final\[.*\n)+", re.MULTILINE)
# Ignore pickle operations that contain no values of the exported policy.
_BOOKKEEPING = {"PROTO", "FRAME", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"}


def exported_part(a: RunDirectory, b: RunDirectory) -> Part:
    """Compare the exported policies: their bytes, and if these differ, their weights, code, and graphs."""
    folders = [run.exported for run in (a, b)]
    ones, others = ({p.name: p for p in f.iterdir() if p.is_file()} if f.is_dir() else {} for f in folders)
    if not ones or not others:
        sides = [side for side, files in (("A", ones), ("B", others)) if files]
        return Part("not compared", f"only {sides[0]} exported a policy" if sides else "neither run exported a policy")
    files = {name: _compare(ones.get(name), others.get(name)) for name in sorted({*ones, *others})}
    odd = {name: what for name, what in files.items() if what != _EQUAL}
    if not odd:
        return Part("equal", f"{len(files)} files, byte for byte", {"files": files})
    text = "; ".join(f"{name}: {what}" for name, what in odd.items())
    return Part("equal" if set(odd.values()) == {_EQUAL_CONTENT} else "different", text, {"files": files})


def _compare(a: Path | None, b: Path | None) -> str:
    if a is None or b is None:
        return "only in A" if a else "only in B"
    if read_bytes(a) == read_bytes(b):
        return _EQUAL
    try:
        if a.suffix == ".json":
            changes = plain_changes(read_json(a), read_json(b))
            return f"differs in {first_few([change.key for change in changes])}" if changes else _EQUAL_CONTENT
        read = _of_onnx if a.suffix == ".onnx" else _of_archive
        (weights, code), (other_weights, other_code) = read(a), read(b)
        differing = ["weights differ"] if weights != other_weights else []
        differing += ["code differs"] if code != other_code else []
        return " and ".join(differing) or _EQUAL_CONTENT
    except Exception as error:  # Reading a damaged file can raise any exception.
        return f"cannot be read: {str(error).splitlines()[0] if str(error) else type(error).__name__}"


def _of_archive(path: Path) -> tuple[object, object]:
    """Return the weights of a TorchScript archive, and its code with the operations of its pickles."""
    # Do not load the archive, because loading an archive runs the archive's code.
    # TorchScript numbers its classes and orders its constants differently in each process, so ignore numbers and order.
    weights: dict[str, bytes] = {}
    found: dict[str, list[str]] = {}
    with zipfile.ZipFile(path) as archive:
        require_bounded(archive)
        for name in archive.namelist():
            inner = name.split("/", 1)[-1]
            if "/data/" in name or "/constants/" in name:
                weights[inner] = archive.read(name)
            if inner.endswith(".pkl"):
                # List the operations of a pickle file without running them.
                used = (x for x in pickletools.genops(archive.read(name)) if x[0].name not in _BOOKKEEPING)
                found[inner] = [f"{operation.name} {_NUMBER.sub('', repr(value))}" for operation, value, _ in used]
            elif inner.startswith("code/") and not inner.endswith(".debug_pkl"):
                # Compare the set of classes and functions, with sorted constants.
                code = _NUMBER.sub("", archive.read(name).decode())
                code = _CONSTANTS.sub(lambda found: "".join(sorted(found[0].splitlines(keepends=True))), code)
                plain, parts = _NUMBER_IN_PATH.sub("", inner), re.split(r"^(?=class |def )", code, flags=re.MULTILINE)
                found[plain] = sorted([*found.get(plain, []), *parts])
    return weights, found


def _of_onnx(path: Path) -> tuple[object, object]:
    """Return the weights of an ONNX file, and its graph as bytes without weights and without its producer."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load(path, load_external_data=False)
    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    weights = {name: (x.shape, str(x.dtype), x.tobytes()) for name, x in arrays.items()}
    for name in ("ir_version", "producer_name", "producer_version", "domain", "model_version"):
        model.ClearField(name)
    model.graph.ClearField("initializer")
    _clear_texts(model)
    return weights, model.SerializeToString(deterministic=True)


def _clear_texts(message: Any) -> None:
    """Clear the documentation texts and metadata in a protobuf message and in all nested messages."""
    for entry, value in message.ListFields():
        if entry.name in ("doc_string", "metadata_props"):
            message.ClearField(entry.name)
        elif entry.message_type is not None:
            for inner in [value] if hasattr(value, "ListFields") else value:
                _clear_texts(inner)
