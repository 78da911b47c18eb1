"""Trained policies that ship with ``wheelleg_exp``: one zip file each, in ``assets/policies``.

``stock:walk`` is ``walk.zip``, which its first use unpacks below ``<root>/stock``. Without log, source, and optimiser,
the run can be played, evaluated, and exported, but not resumed or replayed.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.files import for_people, read_text, read_yaml, sha256, sync_folder, temporary_folder
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.run.file_inventory import MANIFEST_NAME

PREFIX, FOLDER, SUMS, GATES = "stock:", "stock", "SHA256SUMS", "gates.yaml"


def stock_names() -> list[str]:
    """Return the names of the policies that ship with ``wheelleg_exp``, such as ``walk``."""
    return sorted(path.stem for path in (assets_dir() / "policies").glob("*.zip"))


def stock_run(name: str, root: Path) -> Path:
    """Return the run directory of a policy that ships with ``wheelleg_exp``, below ``<root>/stock``.

    An unknown name, a zip file with another SHA-256, and changed files of the run directory raise RunDirectoryError.
    """
    known = [PREFIX + other for other in stock_names()]
    if PREFIX + name not in known:
        message, nearest = f"no policy '{PREFIX}{name}' ships with wheelleg_exp", nearest_name(PREFIX + name, known)
        raise RunDirectoryError(message, expected="one of " + ", ".join(known), nearest=nearest)
    packed = assets_dir() / "policies" / f"{name}.zip"
    digest = sha256(packed)
    if f"{digest}  {packed.name}" not in read_text(packed.with_name(SUMS)).splitlines():
        expected = f"its SHA-256 in {SUMS}; install wheelleg_exp again"
        raise RunDirectoryError("the file is damaged", key=str(packed), expected=expected)
    # The digest in the folder's name separates the policies of different versions of ``wheelleg_exp``.
    target = root / FOLDER / f"{name}_{digest[:8]}"
    if not target.exists():
        with for_people(target), zipfile.ZipFile(packed) as archive, temporary_folder(target) as folder:
            archive.extractall(folder)
            try:
                folder.rename(target)
            except OSError:
                if not target.is_dir():  # Another process can unpack the same policy at the same time.
                    raise
            sync_folder(target.parent)
    if (path := _changed_file(packed, target)) is not None:
        message = f"the file differs from the policy '{PREFIX}{name}', which was unpacked to '{target}'"
        expected = f"an unchanged file; delete '{target}' to have it unpacked again"
        raise RunDirectoryError(message, key=str(path), expected=expected)
    return target


def known_fault(name: object) -> str | None:
    """Return the reason why the policy ``name`` ships although it does not meet the bounds of standing, or None."""
    fault: str | None = read_yaml(assets_dir() / "policies" / GATES)["exempt"].get(str(name))
    return fault


def is_stock(folder: Path, name: object) -> bool:
    """Return whether a folder contains the unchanged files of the policy ``name`` that ships with ``wheelleg_exp``."""
    return name in stock_names() and _changed_file(assets_dir() / "policies" / f"{name}.zip", folder) is None


def refuse_stock(folder: Path, name: object) -> None:
    """Raise RunDirectoryError for a policy that ships with ``wheelleg_exp``, whose training nobody can continue."""
    if is_stock(folder, name):
        message = f"'{PREFIX}{name}' ships without the log, the source, and the optimiser of its training"
        raise RunDirectoryError(message, expected=f"a run of your own, or a new training with init_from={PREFIX}{name}")


def _changed_file(packed: Path, folder: Path) -> Path | None:
    with zipfile.ZipFile(packed) as archive:
        for entry in archive.namelist():
            path = folder / entry
            # Commands such as ``wheelleg play`` add entries to the manifest.
            if not path.is_file() or (entry != MANIFEST_NAME and path.read_bytes() != archive.read(entry)):
                return path
    return None
