"""Starts a training in a process whose imports come from restored source trees.

It is run as a file, before anything of this package is imported: the last argument is JSON that says in which folder
each top-level package or module is found. What this package does not hold there is not looked for elsewhere, where
another version of it may be installed.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType

_OWN = "wheelleg_exp"


class RestoredFinder:
    """Finds the modules of restored packages in their restored folders.

    Args:
        places: folder by top-level name.
    """

    def __init__(self, places: dict[str, str]) -> None:
        self._places = places

    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module; None leaves it to the others.

        Raises:
            ModuleNotFoundError: the module belongs to this package and is not in its restored folder.
        """
        top = fullname.partition(".")[0]
        if top not in self._places:
            return None
        spec = PathFinder.find_spec(fullname, [self._places[top]] if path is None else path, target)
        if spec is None and top == _OWN:
            raise ModuleNotFoundError(f"the restored source holds no module {fullname}", name=fullname)
        return spec


def main() -> int:
    """Take the imports over and train."""
    sys.meta_path.insert(0, RestoredFinder(json.loads(sys.argv.pop())))
    from wheelleg_exp.jobs.snapshot_training import main as train

    return train()


if __name__ == "__main__":
    sys.exit(main())
