"""Start a training in a process that imports packages from restored source folders.

This file runs as a script, before any module of ``wheelleg_exp`` is imported. Its last argument is JSON: the folder of
each top-level package or module. A module that the restored source lacks is not imported from ``sys.path``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

_OWN = "wheelleg_exp"
# Older versions of wheelleg_exp have the module ``snapshot_training`` in another folder.
ENTRIES = ("jobs/replay/snapshot_training", "jobs/snapshot_training")


class RestoredFinder:
    """Makes Python import a package from the folder into which a replay restored the package's source code."""

    def __init__(self, places: dict[str, str]) -> None:
        self._places = places

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the import spec of a module; raise ModuleNotFoundError if the restored source lacks this module."""
        top = fullname.partition(".")[0]
        if top not in self._places:
            return None
        spec = PathFinder.find_spec(fullname, [self._places[top]] if path is None else path, target)
        if spec is None and top == _OWN:
            raise ModuleNotFoundError(f"the restored source code of the run lacks the module {fullname}", name=fullname)
        return spec


def main() -> int:
    """Train a run again with packages that Python imports from the restored copy of the run's source code."""
    places = json.loads(sys.argv.pop())
    sys.meta_path.insert(0, RestoredFinder(places))
    own = Path(places[_OWN]) / _OWN
    entry = next(entry for entry in ENTRIES if own.joinpath(f"{entry}.py").is_file())
    return int(import_module(f"{_OWN}.{entry.replace('/', '.')}").main())


if __name__ == "__main__":
    sys.exit(main())
