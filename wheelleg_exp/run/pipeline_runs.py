"""The runs that a pipeline's record names, for whoever has been given the pipeline in the place of a run."""

from __future__ import annotations

from pathlib import Path

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json
from wheelleg_exp.run.inventory import MANIFEST_NAME
from wheelleg_exp.run.kinds import Maybe, misfits

PIPELINE_NAME = "pipeline.json"


def is_pipeline(folder: Path) -> bool:
    """Return whether a folder is a pipeline's: a run directory is not, whatever else someone has put into it."""
    return (folder / PIPELINE_NAME).is_file() and not (folder / MANIFEST_NAME).exists()


def no_run_but(folder: Path) -> RunDirectoryError | None:
    """Return what to tell of a folder that is a pipeline's: the runs of its phases; None of any other folder."""
    path = folder if folder.name == PIPELINE_NAME else folder / PIPELINE_NAME
    if not is_pipeline(path.parent):
        return None
    data = read_json(path)
    known = not any(misfits(data, {"phases": [{"name": str, "run": Maybe(str)}]}))
    begun = [phase for phase in data["phases"] if phase["run"]] if known else []
    runs = [f"{_shown(path.parent / phase['run'])} (phase '{phase['name']}')" for phase in begun]
    return RunDirectoryError(
        f"'{path.parent.name}' is a pipeline, and each of its phases is a run",
        expected=" or ".join(runs) if runs else "a run of it, once its first phase has begun",
    )


def _shown(path: Path) -> str:
    """Return a path as one would type it from here."""
    found, here = path.resolve(), Path.cwd()
    return str(found.relative_to(here)) if found.is_relative_to(here) else str(found)
