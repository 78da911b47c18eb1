"""Finds the files that a URDF names, without a ROS installation."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote

from wheelleg_exp.asset.sources import LARGEST_TEXT, require_plain_file
from wheelleg_exp.asset.urdf.document import PACKAGE, Document
from wheelleg_exp.asset.urdf.meshes import READERS
from wheelleg_exp.asset.usd.stage import file_hash, relative_name
from wheelleg_exp.errors import AssetError

LEVELS = 6  # folders to climb in search of a package
_SCHEME = re.compile(r"^([a-z][a-z0-9+.-]+):/{0,2}", re.IGNORECASE)


@dataclass
class Files:
    """The files of one URDF: found ones with their sha256 by path as seen from its folder, and missing names."""

    document: Document
    hashes: dict[str, str] = field(default_factory=dict)
    missing: dict[str, None] = field(default_factory=dict)
    _found: dict[str, Path | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.folder = self.document.source.resolve().parent
        self.mesh_folder = self._mesh_folder()
        self._note(self.document.source)

    def find(self, name: str, endings: tuple[str, ...] = tuple(READERS)) -> Path | None:
        """Return the file that a ``filename`` means, None when it is not there, or ends as no such file does.

        What a robot has no use for is neither read nor looked for: ``/etc/passwd`` is no mesh.

        Raises:
            AssetError: it is too large, or cannot be read.
        """
        if not name.lower().endswith(endings):
            return None
        if name not in self._found:
            plain = PACKAGE.sub(r"package://\1/", name).replace("\\", "/")
            path = next((path for path in self._candidates(plain) if _readable(path)), None)
            self._found[name] = path
            if path is None:
                self.missing[name] = None
            else:
                self._note(path)
        return self._found[name]

    def _note(self, path: Path) -> None:
        require_plain_file(path, "a mesh or a texture", LARGEST_TEXT, where=str(self.document.source))
        try:
            self.hashes[relative_name(path, self.folder)] = file_hash(path)
        except OSError as error:
            message = f"'{path}' cannot be read: {error.strerror}"
            raise AssetError(message, where=str(self.document.source), expected="a mesh or a texture") from None

    def _mesh_folder(self) -> str | None:
        """Return the folder that MuJoCo's extension of URDF names for meshes."""
        extension = self.document.root.first("mujoco")
        compiler = extension.first("compiler") if extension else None
        return self.document.text(compiler, "meshdir", "the search for mesh files") if compiler else None

    def _candidates(self, name: str) -> Iterator[Path]:
        """Yield where a file may be: beside the URDF, in its package, or in a folder above both."""
        scheme = _SCHEME.match(name)
        if scheme is None:
            yield self.folder / name
            yield from self._moved(name)
            if self.mesh_folder is not None:
                yield self.folder / self.mesh_folder / name
                yield self.folder / self.mesh_folder / Path(name).name
            yield from (above / name for above in self._above())
        elif scheme.group(1).lower() == "file":
            for path in dict.fromkeys((name[scheme.end() :], unquote(name[scheme.end() :]))):
                yield Path("/" + path.lstrip("/"))
                yield self.folder / path
                yield from self._moved("/" + path.lstrip("/"))
        elif scheme.group(1).lower() in ("package", "model"):
            yield from self._in_package(*name[scheme.end() :].partition("/")[::2])

    def _moved(self, name: str) -> Iterator[Path]:
        """Yield the local places of an absolute path that another machine wrote.

        The path ends in ``share/PACKAGE/REST``, or in ``FOLDER/REST`` with a folder that contains the URDF.
        """
        parts = Path(name).parts if name.startswith("/") else ()
        around = {above.name for above in (self.folder, *self._above())}
        for index in range(1, len(parts) - 1):
            if parts[index - 1] == "share" or parts[index] in around:
                yield from self._in_package(parts[index], "/".join(parts[index + 1 :]))

    def _in_package(self, package: str, rest: str) -> Iterator[Path]:
        """Yield files of a package: a folder of that name, or one above that the package was checked out to."""
        for above in (self.folder, *self._above()):
            if above.name == package:
                yield above / rest
            yield above / package / rest
        yield from (above / rest for above in (self.folder, *self._above()))

    def _above(self) -> list[Path]:
        return list(self.folder.parents)[:LEVELS]


def _readable(path: Path) -> bool:
    """Return whether a path is a file that can be opened; odd names are not."""
    try:
        return path.is_file() and os.access(path, os.R_OK)
    except (OSError, ValueError):
        return False
