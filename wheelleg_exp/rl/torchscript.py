"""TorchScript archives whose bytes depend on the module alone.

``torch.jit.save`` writes constants in the order of a Python set (another one in each process), numbers classes by what
was scripted before in the process, and tells where on this disk each line of the source stood. Here constants are
sorted, classes are numbered by their first appearance in the module, and the places are left out.
"""

from __future__ import annotations

import io
import re
import warnings
import zipfile

import torch

_SOURCE, _DATA, _PLACES, _IDENTITY = ".py", "data.pkl", ".debug_pkl", ".data/serialization_id"
_WRITERS_OWN = ("version", "byteorder", _IDENTITY)

_NAME = re.compile(rb"__torch__(?:\.\w+)+")
_PICKLED = re.compile(rb"c(__torch__[\w.]*)\n(\w+)\n")  # pickle's opcode GLOBAL: module, newline, name, newline
_DEFINITION = re.compile(rb"^(?:class|def) (\w+)", re.MULTILINE)
_CONSTANTS = re.compile(rb"(?:^  \w+ : Final\[.*\n)+", re.MULTILINE)
_MANGLED = re.compile(rb"\.___torch_mangle_\d+")


def serialize(module: torch.nn.Module) -> bytes:
    """Script a module and return its archive for ``torch.jit.load``; equal modules give equal bytes."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.jit.save(torch.jit.script(module), buffer)
    return canonical(buffer.getvalue())


def canonical(archive: bytes) -> bytes:
    """Return a TorchScript archive without what depends on the process or the disk that it was made on."""
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        records = {name.split("/", 1)[1]: opened.read(name) for name in opened.namelist()}
    units = _units(records)
    names = _numbered(units, records[_DATA])
    written = {}
    for record, content in records.items():
        if record == _DATA:
            written[record] = _PICKLED.sub(lambda found: _pickled(names, found), content)
        elif not record.endswith((_SOURCE, _PLACES)) and record not in _WRITERS_OWN:
            written[record] = content
    for name, new in names.items():
        written[_file_of(new)] = written.get(_file_of(new), b"") + _rewritten(units[name], names)
    return _archive(written)


def _units(records: dict[str, bytes]) -> dict[bytes, bytes]:
    """Return the text of each class and function by its full name, in the archive's order."""
    units = {}
    for record, text in records.items():
        if record.endswith(_SOURCE):
            module = record.removeprefix("code/").removesuffix(_SOURCE).replace("/", ".").encode()
            starts = [found.start() for found in _DEFINITION.finditer(text)]
            for start, end in zip(starts, [*starts[1:], len(text)], strict=True):
                found = _DEFINITION.match(text, start)
                assert found is not None
                units[module + b"." + found[1]] = text[start:end]
    return units


def _numbered(units: dict[bytes, bytes], data: bytes) -> dict[bytes, bytes]:
    """Return each unit's new name; those in the data come first, in their order there, then the others by text."""
    used = [module + b"." + name for module, name in _PICKLED.findall(data)]
    rest = sorted((_MANGLED.sub(b"", name), text, name) for name, text in units.items() if name not in used)
    ordered = [*dict.fromkeys(used), *(name for _, _, name in rest)]
    taken: set[bytes] = set()
    names: dict[bytes, bytes] = {}
    for name in ordered:
        if name not in units:
            continue
        plain = _MANGLED.sub(b"", name)
        module, _, last = plain.rpartition(b".")
        names[name] = plain if plain not in taken else b"%b.___torch_mangle_%d.%b" % (module, len(names), last)
        taken.add(plain)
    return names


def _pickled(names: dict[bytes, bytes], found: re.Match[bytes]) -> bytes:
    new = names.get(found[1] + b"." + found[2])
    return found[0] if new is None else b"c%b\n%b\n" % tuple(new.rsplit(b".", 1))


def _rewritten(text: bytes, names: dict[bytes, bytes]) -> bytes:
    text = _CONSTANTS.sub(lambda found: b"".join(sorted(found[0].splitlines(keepends=True))), text)
    return _NAME.sub(lambda found: _renamed(found[0], names), text)


def _renamed(name: bytes, names: dict[bytes, bytes]) -> bytes:
    """Return a reference to a unit, or to something inside of one, with the unit's new name."""
    head, tail = name, b""
    while head not in names and b"." in head:
        head, _, last = head.rpartition(b".")
        tail = b"." + last + tail
    return names[head] + tail if head in names else name


def _file_of(name: bytes) -> str:
    return f"code/{name.rpartition(b'.')[0].decode().replace('.', '/')}{_SOURCE}"


def _archive(records: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    writer = torch._C.PyTorchFileWriter(buffer)
    for name, content in records.items():
        writer.write_record(name, content, len(content))
    writer.write_end_of_file()
    return buffer.getvalue()
