"""A package that was installed rather than worked on: its distribution, and one digest over its files."""

from __future__ import annotations

import hashlib
import os
from importlib import metadata
from pathlib import Path

from wheelleg_exp.files import sha256

_INSTALL_FOLDERS = ("site-packages", "dist-packages")


def is_installed(root: Path, above: Path | None = None) -> bool:
    """Return whether ``root`` lies in an environment's folder of packages, as seen from the folder ``above``."""
    parts = root.parts if above is None else root.relative_to(above).parts
    return any(part in _INSTALL_FOLDERS for part in parts)


def distribution(root: Path) -> str | None:
    """Return ``name==version`` of the distribution that a package's folder or file belongs to, if one says so."""
    places = [place for place in root.parents if place.name in _INSTALL_FOLDERS]
    if not places:
        return None
    top = root.relative_to(places[0]).parts[0]
    for found in metadata.distributions(path=[str(places[0])]):
        if any(file.parts and file.parts[0] == top for file in found.files or ()):
            return f"{found.metadata['Name']}=={found.version}"
    return None


def content_digest(root: Path) -> str:
    """Return one sha256 over names and contents of the readable files at ``root``, bytecode left out."""
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*")) if root.is_dir() else [root]:
        if path.is_file() and "__pycache__" not in path.parts and os.access(path, os.R_OK):
            digest.update(os.fsencode(path.relative_to(root)) + b"\0" + sha256(path).encode() + b"\n")
    return digest.hexdigest()
