"""The runs that a pipeline's record names, for whoever has been given the pipeline in the place of a run."""

from __future__ import annotations

from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json

PIPELINE_NAME = "pipeline.json"


def no_run_but(folder: Path) -> RunDirectoryError | None:
    """Return what to tell of a folder that is a pipeline's: the runs of its phases; None of any other folder."""
    path = folder if folder.name == PIPELINE_NAME else folder / PIPELINE_NAME
    if not path.is_file():
        return None
    data = read_json(path)
    phases = data.get("phases") if isinstance(data, dict) else None
    begun = [phase for phase in phases or [] if isinstance(phase, dict) and phase.get("run")]
    runs = [f"{_shown(path.parent / phase['run'])} (phase '{phase['name']}')" for phase in begun]
    return RunDirectoryError(
        f"'{path.parent.name}' is a pipeline, and each of its phases is a run",
        expected=" or ".join(runs) if runs else "a run of it, once its first phase has begun",
    )


def _shown(path: Path) -> str:
    """Return a path as one would type it from here."""
    found, here = path.resolve(), Path.cwd()
    return str(found.relative_to(here)) if found.is_relative_to(here) else str(found)
