"""Reading a recording back: what it holds, as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from wheelleg_exp.errors import RunDirectoryError, nearest_name
from wheelleg_exp.recording.layout import DOCUMENTS, join, key_below
from wheelleg_exp.recording.reading import events, groups, statics
from wheelleg_exp.recording.reading.events import Event
from wheelleg_exp.recording.reading.groups import Names, Number
from wheelleg_exp.recording.reading.rows import EntityRows


class Recording(EntityRows):
    """A recording, read from its file as far as that is whole; ``health`` says how far that is.

    Opening it reads the file once, to know what it holds; rows are read when they are asked for, and only those of
    the entities asked for. Arguments and errors are those of ``EntityRows``.
    """

    def groups(self) -> list[str]:
        """Return the paths above those that hold numbers, as ``table`` takes them: ``rewards``, ``joints``."""
        return list(self._names.groups)

    def table(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return what was recorded over time at an entity, or at a group of them, sorted by step.

        Args:
            name: an entity, or a group: ``rewards``, ``base``, ``joints/<joint>``, ``training``, …
            env_id: which recorded environment; by default the first.

        Returns:
            Of an entity: columns ``step``, ``sim_time`` (duration), ``iteration`` where there is one, and one list
            column a component, by its short name: ``scalars``, ``translation``, ``quaternion``, ``vectors``, ``text``.
            Of a group: ``step``, ``sim_time`` (s), ``iteration`` where there is one, and one float64 column a number,
            whose name is its path below the group with dots; NaN where a number has no row at a step. What has no
            ``step`` is counted by rows.

        Raises:
            RunDirectoryError: there is neither, or it is larger than the limit.
        """
        path = self._resolved(name, env_id)
        if self.has_rows(path):
            return self.rows(path)
        return self.numbers(name, env_id)

    def numbers(self, name: str, env_id: int | None = None) -> pa.Table:
        """Return the numbers of an entity or a group as ``table`` returns those of a group (raises as that)."""
        path = self._resolved(name, env_id)
        return self._kept("numbers", path, lambda path: self.columns_of(self._names.numbers_of(path)))

    def all_numbers(self, env_id: int | None = None) -> dict[str, Number]:
        """Return every number of an environment, and those of none, by its name with dots: ``rewards.alive``."""
        return self._names.all(self.branch(env_id))

    def columns_of(self, numbers: Sequence[Number]) -> pa.Table:
        """Return numbers as ``table`` returns those of a group (RunDirectoryError when they are too many)."""
        self._require_small(8 * sum(self.count(number.entity) for number in numbers), f"{len(numbers)} numbers")
        return groups.table(self, numbers)

    def values(self, name: str, env_id: int | None = None) -> NDArray[np.float64]:
        """Return the numbers of an entity or group, (rows, width), sorted by step.

        Raises:
            RunDirectoryError: there are none, or their width changes.
        """
        path = self._resolved(name, env_id)
        return self.matrix(path) if self.has_rows(path) else groups.matrix(self, self._names.numbers_of(path))

    def names(self, name: str, env_id: int | None = None) -> list[str]:
        """Return the names of the numbers of an entity or group; empty when they have none."""
        path = self._path(name, env_id)
        own = self.number_names(path)
        if own or self.has_rows(path) or path not in self._names.groups:
            return own
        return [number.name for number in self._names.numbers_of(path)]

    def events(self, kind: str | None = None, env_id: int | None = None) -> list[Event]:
        """Return what was told in words, by step.

        Args:
            kind: ``episodes``, ``events`` or ``recording``; by default all.
            env_id: of which environment; by default of all.
        """
        found = events.read(self)
        return [e for e in found if kind in (None, e.kind) and (env_id is None or e.env_id in (None, env_id))]

    def documents(self) -> list[str]:
        """Return the names of the texts."""
        keys = (key_below(DOCUMENTS, entity) for entity in self.entities())
        return [key for key in keys if key is not None]

    def document(self, name: str) -> str | None:
        """Return a text by its name, None when there is none."""
        text = self.static(join(DOCUMENTS, name)).get("text")
        return str(text[0]) if text else None

    @cached_property
    def properties(self) -> Mapping[str, Mapping[str, Any]]:
        """The properties of the recording by name: ``wheelleg``, ``robot``; a list of one stands for itself."""
        return statics.properties(self, self._contents.pieces)

    @cached_property
    def purpose(self) -> str | None:
        """``training``, ``play`` or ``evaluation``; None for a recording of another tool."""
        return statics.purpose(self.properties, self.entities())

    @cached_property
    def env_ids(self) -> list[int]:
        """The recorded environments; [0] when it does not say."""
        return statics.env_ids(self, self.properties, self.branches)

    @cached_property
    def step_dt(self) -> float | None:
        """Simulated time of a control step, s; None when it is not known."""
        return statics.step_dt(self, self.properties)

    @cached_property
    def branches(self) -> list[int]:
        """The environments that have a branch of their own, because several were recorded."""
        return statics.branches(self.entities())

    def branch(self, env_id: int | None = None) -> str:
        """Return the path in front of an environment's data; empty when one alone was recorded.

        Raises:
            RunDirectoryError: that environment was not recorded.
        """
        if env_id is not None and env_id not in self.env_ids:
            raise RunDirectoryError(
                f"environment {env_id} was not recorded in '{self.path}'",
                expected="one of " + ", ".join(map(str, self.env_ids)),
            )
        chosen = self.env_ids[0] if env_id is None else env_id
        return f"env_{chosen}" if chosen in self.branches else ""

    @cached_property
    def _names(self) -> Names:
        return Names(self)

    def _path(self, name: str, env_id: int | None) -> str:
        """Return the path that ``name`` stands for: itself, or what it is below the environment's branch."""
        path, branch = name.strip("/"), self.branch(env_id)
        below = "/".join(part for part in (branch, path) if part)
        if env_id is None and (path in self._contents.pieces or path in self._names.groups):
            return path
        return below if below in self._contents.pieces or below in self._names.groups else path

    def _resolved(self, name: str, env_id: int | None) -> str:
        """Return the path of an entity with rows or of a group."""
        path = self._path(name, env_id)
        if self.has_rows(path) or path in self._names.groups:
            return path
        names = sorted({*(e for e in self.entities() if self.has_rows(e)), *self._names.groups})
        known = [n.removeprefix(f"{self.branch(env_id)}/") for n in names]
        raise RunDirectoryError(
            f"the recording '{self.path}' has no rows at '{name}'",
            expected="one of: " + ", ".join(known[:40]) + (", …" if len(known) > 40 else ""),
            nearest=nearest_name(name.strip("/"), known),
        )
