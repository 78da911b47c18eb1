"""Copy a robot file and all files to which the robot file refers."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.asset.convert_robot import is_urdf
from wheelleg_exp.asset.file_limits import LARGEST_FILE, LOOKS, MESHES, TEXTURES, bounded_memory
from wheelleg_exp.asset.urdf.mesh_files import Files
from wheelleg_exp.asset.urdf.urdf_document import open_document
from wheelleg_exp.asset.usd.usd_layers import open_layers
from wheelleg_exp.asset.usd.usd_stage import SUFFIXES, library
from wheelleg_exp.errors import AssetError

if TYPE_CHECKING:
    from pxr import Sdf, UsdUtils


def copy_robot(source: Path, folder: Path) -> Path:
    """Copy a robot file, and every layer, texture, or mesh to which the file refers, to ``folder``.

    Relative paths remain; files from outside the folder get new paths, which the copy names. Return the copy's path.
    """
    folder.mkdir(parents=True)
    return _copy_urdf(source, folder) if is_urdf(source, {}) else _copy_usd(source, folder)


def _copy_usd(source: Path, folder: Path) -> Path:
    from pxr import UsdUtils

    with library(source), bounded_memory(source):
        chosen = _chosen(source)
        layers, assets, _ = UsdUtils.ComputeAllDependencies(str(source.resolve()), chosen)
        files = {Path(layer.realPath.split("[")[0]) for layer in layers if layer.realPath}
        files |= {Path(asset.split("[")[0]) for asset in assets}
        files = {file.resolve() for file in files if file.is_file()}
        home = source.resolve().parent
        if all(file.is_relative_to(home) for file in files):
            for file in {source.resolve(), *files}:
                _copy(file, folder / file.relative_to(home))
            if source.name != source.resolve().name:  # Copy the robot file also under the name of its symbolic link.
                _copy(source, folder / source.name)
            return folder / source.name
        # The USD library copies files from outside the robot's folder, and updates their paths in the copies.
        done = UsdUtils.LocalizeAsset(str(source.resolve()), str(folder), False, chosen)
        if not done or not (folder / source.name).is_file():
            message, expected = "the robot's layers cannot be copied", "a file whose layers lie in its own folder"
            raise AssetError(message, where=str(source), expected=expected)
    return folder / source.name


def _chosen(source: Path) -> Callable[[Sdf.Layer, UsdUtils.DependencyInfo], UsdUtils.DependencyInfo]:
    """Return a filter with which the USD library copies only the layers, textures, and materials of a robot.

    Without a filter, a project would contain a copy of any file that a robot file names, such as ``/etc/passwd``.
    """
    from pxr import UsdUtils

    found: dict[str, Sdf.Layer] = {}
    todo = open_layers(source)
    while todo:
        item = todo.pop()
        if item.identifier not in found:
            found[item.identifier] = item
            paths = {Path(item.ComputeAbsolutePath(name)) for name in _asset_paths(item)}
            for path in sorted(paths):
                if str(path) not in found and path.suffix.lower() in SUFFIXES and path.exists():
                    todo += open_layers(path)
    layers = {layer.realPath for layer in list(found.values())}

    def choose(layer: Sdf.Layer, named: UsdUtils.DependencyInfo) -> UsdUtils.DependencyInfo:
        names = [layer.ComputeAbsolutePath(name) for name in (named.assetPath, *named.dependencies)]
        files = [Path(name) for name in names if name not in layers]
        # A name can be a pattern that matches several textures or materials.
        small = [not file.exists() or (file.is_file() and file.stat().st_size <= LARGEST_FILE) for file in files]
        looks = all(file.suffix.lower() in LOOKS for file in files)
        return named if looks and all(small) else UsdUtils.DependencyInfo()

    return choose


def _asset_paths(layer: Sdf.Layer) -> set[str]:
    from pxr import Sdf, UsdUtils

    found: set[str] = set()

    def note(name: str) -> str:
        found.add(name)
        return name

    copy = Sdf.Layer.CreateAnonymous()
    copy.TransferContent(layer)
    UsdUtils.ModifyAssetPaths(copy, note)
    return found


def _copy(file: Path, to: Path) -> None:
    to.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, to)


def _copy_urdf(source: Path, folder: Path) -> Path:
    document = open_document(source)
    files = Files(document)
    elements = [element for element in document.root.walk() if element.tag in ("mesh", "texture")]
    names = {name for element in elements if (name := element.attributes.get("filename"))}
    paths = {name: files.find(name, (*MESHES, *TEXTURES)) for name in sorted(names)}
    found = {name: path.resolve() for name, path in paths.items() if path is not None}
    # The copied URDF keeps the relative paths of the files that are below its folder.
    kept, text = {}, source.read_bytes()
    for name, path in found.items():
        plain = Path(os.path.normpath(name))
        beside = source.resolve().parent / plain
        is_below = not plain.is_absolute() and plain.parts[0] != ".." and ":" not in name and "\\" not in name
        if is_below and beside.is_file() and beside.resolve() == path:
            kept[name] = plain.as_posix()
    taken = {found[name]: place for name, place in kept.items()}
    for name, path in found.items():
        place = kept.get(name)
        if place is None:
            place = taken.setdefault(path, _free(f"meshes/{path.name}", taken))
            text = _renamed(text, name, place)
        _copy(path, folder / place)
    copy = folder / source.name
    copy.write_bytes(text)
    return copy


def _free(name: str, taken: dict[Path, str]) -> str:
    used = {place.lower() for place in taken.values()}
    path, number = Path(name), 2
    while name.lower() in used:
        name, number = path.with_stem(f"{path.stem}_{number}").as_posix(), number + 1
    return name


def _renamed(text: bytes, name: str, place: str) -> bytes:
    from xml.sax.saxutils import escape

    written = {escape(name), name}
    for form in written:
        quoted = re.compile(rb"(filename\s*=\s*)([\"'])" + re.escape(form.encode()) + rb"\2")
        text = quoted.sub(lambda match: match.group(1) + b'"' + escape(place).encode() + b'"', text)
    return text
