"""What the actions of ``wheelleg inspect`` share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import UsageError
from wheelleg_exp.errors import EXIT_OK, RunDirectoryError

if TYPE_CHECKING:
    from wheelleg_exp.inspection.questions.selection import Selection
    from wheelleg_exp.inspection.questions.target import Target
    from wheelleg_exp.recording.reading.reader import Recording

ROWS = ("env", "iteration", "begin", "end")  # the options that choose rows


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
        from wheelleg_exp.recording.reading.reader import Recording

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
        options: the options, by their names in ``args``, that mean something to it.
    """

    name: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Inspected], Result]
    options: tuple[str, ...] = ()

    def is_chosen(self, args: argparse.Namespace) -> bool:
        """Return whether the command line asks for it."""
        return getattr(args, self.name) not in (None, False)


# Options whose names in ``args`` are others.
_WORDS = {"begin": "--from", "end": "--to"}


def require_used(args: argparse.Namespace, chosen: Sequence[Action], actions: Sequence[Action]) -> None:
    """Raise UsageError when an option is given that means nothing to any of the chosen actions."""
    used = {option for action in chosen for option in action.options}
    for option in dict.fromkeys(option for action in actions for option in action.options):
        if option not in used and getattr(args, option) not in (None, False, []):
            word = _WORDS.get(option, "--" + option.replace("_", "-"))
            users = [f"--{action.name}" for action in actions if option in action.options]
            raise UsageError("it means nothing here", key=word, expected=" or ".join(users) + " beside it")


def other_recording(args: argparse.Namespace) -> Recording:
    """Return the recording that ``--compare`` names; ``--play`` and ``--id`` are meant for it where it has such."""
    from wheelleg_exp.inspection.questions.target import find_target, names_a_run
    from wheelleg_exp.recording.reading.reader import Recording

    path = find_target(args.compare, args.root, play=args.play and names_a_run(args.compare)).path
    try:
        return Recording(path)
    except RunDirectoryError:
        if args.id is None:
            raise
        return Recording(path, recording_id=args.id)
