"""Copies a robot's file with everything that it is made of, so that the copy stands on its own."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable
from pathlib import Path

from wheelleg_exp.asset.conversion import is_urdf
from wheelleg_exp.asset.reader.stage import library
from wheelleg_exp.asset.reader.urdf.document import open_document
from wheelleg_exp.asset.reader.urdf.files import Files
from wheelleg_exp.errors import AssetError


def copy_robot(source: Path, folder: Path) -> Path:
    """Copy a robot's file, and every layer, texture or mesh that it names, into ``folder``.

    What lies beside the source or below it keeps its place. Other files come to stand below the folder as well, and
    what names them is rewritten.

    Returns:
        The copy of ``source``.

    Raises:
        AssetError: the source cannot be read, or is no robot's file.
    """
    folder.mkdir(parents=True)
    return _copy_urdf(source, folder) if is_urdf(source, {}) else _copy_usd(source, folder)


def _copy_usd(source: Path, folder: Path) -> Path:
    from pxr import UsdUtils

    with library(source):
        layers, assets, _ = UsdUtils.ComputeAllDependencies(str(source.resolve()))
        files = {Path(layer.realPath.split("[")[0]) for layer in layers if layer.realPath}
        files |= {Path(asset.split("[")[0]) for asset in assets}
        files = {file.resolve() for file in files if file.is_file()}
        if not _copied_in_place(source, files, folder):
            _localize(source, folder)
    return folder / source.name


def _localize(source: Path, folder: Path) -> None:
    """Let the USD library copy a stage that reaches out of its folder, and rewrite its paths."""
    from pxr import UsdUtils

    if not UsdUtils.LocalizeAsset(str(source.resolve()), str(folder)) or not (folder / source.name).is_file():
        message = "the robot's layers cannot be copied"
        raise AssetError(message, where=str(source), expected="a file whose layers lie in its own folder")


def _copied_in_place(source: Path, files: Iterable[Path], folder: Path) -> bool:
    """Copy files that lie beside the source or below; when one does not, copy nothing and return False."""
    home = source.resolve().parent
    if not all(file.is_relative_to(home) for file in files):
        return False
    for file in {source.resolve(), *files}:
        _copy(file, folder / file.relative_to(home))
    if source.name != source.resolve().name:  # a link to the file that was copied
        _copy(source, folder / source.name)
    return True


def _copy(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, to)


def _copy_urdf(source: Path, folder: Path) -> Path:
    document = open_document(source)
    files = Files(document)
    elements = [element for element in document.root.walk() if element.tag in ("mesh", "texture")]
    names = {name for element in elements if (name := element.attributes.get("filename"))}
    found = {name: path.resolve() for name in sorted(names) if (path := files.find(name)) is not None}
    text = source.read_bytes()
    taken: dict[Path, str] = {}
    for name, path in found.items():
        place = _place_in(name, path, source)
        if place is None:
            place = taken.setdefault(path, _free(f"meshes/{path.name}", taken))
            text = _renamed(text, name, place)
        _copy(path, folder / place)
    copy = folder / source.name
    copy.write_bytes(text)
    return copy


def _place_in(name: str, path: Path, source: Path) -> str | None:
    """Return a mesh's place below the URDF when its name there is just that, and None when it must be rewritten."""
    plain = Path(os.path.normpath(name))
    if plain.is_absolute() or plain.parts[0] == ".." or ":" in name or "\\" in name:
        return None
    beside = source.resolve().parent / plain
    return plain.as_posix() if beside.is_file() and beside.resolve() == path else None


def _free(name: str, taken: dict[Path, str]) -> str:
    """Return a place that no other mesh has, whatever the case of its letters."""
    used = {place.lower() for place in taken.values()}
    path, number = Path(name), 2
    while name.lower() in used:
        name, number = path.with_stem(f"{path.stem}_{number}").as_posix(), number + 1
    return name


def _renamed(text: bytes, name: str, place: str) -> bytes:
    """Return a URDF in which a mesh has another file name; everything else stays as it is, to the byte."""
    from xml.sax.saxutils import escape

    written = {escape(name), name}
    for form in written:
        quoted = re.compile(rb"(filename\s*=\s*)([\"'])" + re.escape(form.encode()) + rb"\2")
        text = quoted.sub(lambda match: match.group(1) + b'"' + escape(place).encode() + b'"', text)
    return text
