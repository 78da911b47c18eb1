"""What the actions of ``wheelleg inspect`` share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.errors import EXIT_OK

if TYPE_CHECKING:
    from wheelleg_exp.inspection.selection import Selection
    from wheelleg_exp.inspection.target import Target
    from wheelleg_exp.recording.reader import Recording


@dataclass(frozen=True)
class Inspected:
    """What the words on the command line name.

    Attributes:
        target: the recording's file, and the run that it belongs to.
        selection: the rows that are looked at (``--env``, ``--iteration``, ``--from``, ``--to``).
        recording_id: which recording of a file that holds several.
    """

    target: Target
    selection: Selection
    recording_id: str | None = None

    @property
    def path(self) -> Path:
        """The recording's file."""
        return self.target.path

    @cached_property
    def recording(self) -> Recording:
        """The recording, opened at the first use."""
        from wheelleg_exp.recording.reader import Recording

        return Recording(self.path, recording_id=self.recording_id)


@dataclass(frozen=True)
class Result:
    """What an action found.

    Attributes:
        document: for ``--json``, which prints it below the action's name.
        show: prints it for people.
        status: the command's exit status; of several actions the highest.
        notes: lines for standard error.
    """

    document: Any
    show: Callable[[], None]
    status: int = EXIT_OK
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Action:
    """One thing that ``wheelleg inspect`` does.

    Attributes:
        name: the option's name in ``args``; the action runs when that is neither None nor False.
        configure: adds its options.
        run: does it.
    """

    name: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Inspected], Result]

    def is_chosen(self, args: argparse.Namespace) -> bool:
        """Return whether the command line asks for it."""
        return getattr(args, self.name) not in (None, False)
