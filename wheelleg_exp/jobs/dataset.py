"""The files of a dataset: the episodes that recorders noted, as numpy's archives (`docs/datasets.md`)."""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import numpy as np

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.files import write_bytes
from wheelleg_exp.managers.recorder_manager import Arrays

_NAME = re.compile(r"(\d+)(_unfinished)?\.npz")


def write_dataset(folder: Path, env: ManagerBasedRLEnv, iteration: int) -> list[Path]:
    """Write the episodes that have ended since the last call, a file for each group; return the files.

    Args:
        folder: the dataset's folder; groups other than ``episodes`` stand in folders of their own below it.
        env: the environment.
        iteration: number of the file.
    """
    return _write(folder, env, f"{iteration:06d}.npz")


def close_dataset(folder: Path, env: ManagerBasedRLEnv, iteration: int | None = None) -> list[Path]:
    """Write what is left, and the episodes under way where ``env.dataset.export_in_close`` asks for it.

    Args:
        folder: the dataset's folder.
        env: the environment.
        iteration: the last one; None where nothing was written before: the file is ``episodes.npz``.
    """
    env.recorder_manager.close()
    return _write(folder, env, "episodes.npz" if iteration is None else f"{iteration:06d}_unfinished.npz")


def dataset_files_from(folder: Path, iteration: int) -> list[Path]:
    """Return the files of ``iteration`` and later ones, and those of episodes that go on after a resume."""
    found = ((path, _NAME.fullmatch(path.name)) for path in folder.rglob("*.npz"))
    return [path for path, match in found if match and (match[2] or int(match[1]) >= iteration)]


def _write(folder: Path, env: ManagerBasedRLEnv, name: str) -> list[Path]:
    paths = []
    for group, arrays in env.recorder_manager.take().items():
        path = (folder if group == "episodes" else folder / group) / name
        write_bytes(path, _archive(arrays))
        paths.append(path)
    return paths


def _archive(arrays: Arrays) -> bytes:
    """Return an ``.npz``: as numpy's own, but the same arrays give the same bytes at any time."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue())
    return archive.getvalue()
