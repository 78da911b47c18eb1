"""Compare exported policies by their weights and graphs. The policies are never run."""

from __future__ import annotations

import hashlib
import pickletools
import re
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.files import read_bytes, read_json
from wheelleg_exp.plain_data import require_bounded
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.verify.run_differences import plain_changes
from wheelleg_exp.verify.run_parts import Part, some

_EQUAL = "equal"
_EQUAL_CONTENT = "weights and code equal, other bytes"
# TorchScript numbers its classes by the order of scripting in a process.
_NUMBER, _NUMBER_IN_PATH = re.compile(r"\.___torch_mangle_\d+"), re.compile(r"/___torch_mangle_\d+(?=[./])")
_CONSTANTS = re.compile(r"(?:^  \w+ : Final\[.*\n)+", re.MULTILINE)
# Pickle operations that hold no value: the protocol version, and positions in the memo.
_BOOKKEEPING = {"PROTO", "FRAME", "PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"}


def exported_part(a: RunDirectory, b: RunDirectory) -> Part:
    """Compare the exported policies: their bytes, and if these differ, their weights, code, and graphs."""
    ones, others = ({path.name: path for path in _files(run.exported)} for run in (a, b))
    if not ones or not others:
        sides = [side for side, files in (("A", ones), ("B", others)) if files]
        return Part("not compared", f"only {sides[0]} exported a policy" if sides else "neither run exported a policy")
    files = {name: _compare(ones.get(name), others.get(name)) for name in sorted({*ones, *others})}
    odd = {name: what for name, what in files.items() if what != _EQUAL}
    if not odd:
        return Part("equal", f"{len(files)} files, byte for byte", {"files": files})
    text = "; ".join(f"{name}: {what}" for name, what in odd.items())
    return Part("equal" if set(odd.values()) == {_EQUAL_CONTENT} else "different", text, {"files": files})


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file()) if folder.is_dir() else []


def _compare(a: Path | None, b: Path | None) -> str:
    if a is None or b is None:
        return "only in A" if a else "only in B"
    one, other = read_bytes(a), read_bytes(b)
    if one == other:
        return _EQUAL
    try:
        return _compare_content(a, b)
    except Exception as error:  # a damaged file can raise any error
        return f"cannot be read: {str(error).splitlines()[0] if str(error) else type(error).__name__}"


def _compare_content(a: Path, b: Path) -> str:
    if a.suffix == ".json":
        changes = plain_changes(read_json(a), read_json(b))
        return f"differs in {some([change.key for change in changes])}" if changes else _EQUAL_CONTENT
    sides: Sequence[Callable[[Path], Any]] = (_onnx_weights, _onnx_graph)
    if a.suffix != ".onnx":
        sides = (_archived_weights, _archived_code)
    texts = ("weights differ", "code differs")
    differing = [text for text, side in zip(texts, sides, strict=True) if side(a) != side(b)]
    return " and ".join(differing) or _EQUAL_CONTENT


# TorchScript archives are never loaded, because loading runs their code.
def _archived_weights(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        require_bounded(archive)
        names = [name for name in archive.namelist() if "/data/" in name or "/constants/" in name]
        return {name.split("/", 1)[1]: archive.read(name) for name in names}


def _archived_code(path: Path) -> dict[str, Any]:
    """Return the code of an archive, and the operations of its pickles: attributes and the order of tensors.

    The numbers of classes and the order of constants are removed: both depend on the process that wrote the archive.
    """
    found: dict[str, Any] = {}
    with zipfile.ZipFile(path) as archive:
        require_bounded(archive)
        for name in archive.namelist():
            inner = name.split("/", 1)[-1]
            if inner.endswith(".pkl"):
                found[inner] = list(_pickled(archive.read(name)))
            elif inner.startswith("code/") and not inner.endswith(".debug_pkl"):
                plain = _NUMBER_IN_PATH.sub("", inner)
                found[plain] = sorted([*found.get(plain, []), *_definitions(archive.read(name).decode())])
    return found


def _definitions(code: str) -> list[str]:
    """Return the classes and functions of a file, without class numbers and with sorted constants."""
    plain = _NUMBER.sub("", code)
    ordered = _CONSTANTS.sub(lambda found: "".join(sorted(found[0].splitlines(keepends=True))), plain)
    return re.split(r"^(?=class |def )", ordered, flags=re.MULTILINE)


def _pickled(data: bytes) -> Iterator[tuple[str, Any]]:
    """Yield the operations of a pickle without running them."""
    for operation, value, _ in pickletools.genops(data):
        if operation.name not in _BOOKKEEPING:
            yield operation.name, _NUMBER.sub("", repr(value))


def _onnx_weights(path: Path) -> dict[str, tuple[Any, ...]]:
    import onnx
    from onnx import numpy_helper

    graph = onnx.load(path, load_external_data=False).graph
    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    return {
        name: (array.shape, str(array.dtype), hashlib.sha256(array.tobytes()).hexdigest())
        for name, array in arrays.items()
    }


def _onnx_graph(path: Path) -> bytes:
    """Return operators, attributes, inputs, outputs, and functions, without the producer's name and version."""
    import onnx

    model = onnx.load(path, load_external_data=False)
    for name in ("ir_version", "producer_name", "producer_version", "domain", "model_version"):
        model.ClearField(name)
    model.graph.ClearField("initializer")
    _clear_texts(model)
    return bytes(model.SerializeToString(deterministic=True))


def _clear_texts(message: Any) -> None:
    """Clear documentation texts and metadata in a message and all messages inside it."""
    for field, value in message.ListFields():
        if field.name in ("doc_string", "metadata_props"):
            message.ClearField(field.name)
        elif field.message_type is not None:
            for inner in [value] if hasattr(value, "ListFields") else value:
                _clear_texts(inner)
