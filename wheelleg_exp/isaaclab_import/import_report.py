"""The report of an import: what happened to each part of the imported config."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export.isaaclab_run import Tree

NAME, RULE, ASSUMED, DROPPED, CODE = "by name", "by rule", "assumed", "dropped", "needs code"
NOT_NEEDED = "not needed"
_MEANINGS = {
    NAME: "the same name exists here, with the same parameters",
    RULE: "written differently here, with the same meaning, or with the named difference",
    ASSUMED: "the run does not say it, or says something else: check it",
    DROPPED: "has no counterpart, for the given reason",
    CODE: "the author's own code: give its folder with --terms",
    NOT_NEEDED: "does not change what the robot does",
}


@dataclass(frozen=True)
class Row:
    """One part of the imported config: its key, what happened to it, and details."""

    key: str
    outcome: str
    text: str


@dataclass
class ImportReport:
    """Collects the rows of an import, in the order of the imported file."""

    rows: list[Row] = field(default_factory=list)

    def add(self, key: str, outcome: str, text: str) -> None:
        self.rows.append(Row(key, outcome, text))

    def replace(self, key: str, outcome: str, text: str) -> None:
        """Add a row in place of all earlier rows with its key."""
        self.rows = [row for row in self.rows if row.key != key]
        self.add(key, outcome, text)

    def of(self, outcome: str) -> list[Row]:
        return [row for row in self.rows if row.outcome == outcome]

    def counts(self) -> str:
        """Return how many rows have each outcome, as text."""
        found = Counter(row.outcome for row in self.rows)
        return ", ".join(f"{found[outcome]} {outcome}" for outcome in _MEANINGS if found[outcome])

    def markdown(self) -> str:
        """Return the report as Markdown: one table per outcome, and first what the user should check."""
        parts = [f"{self.counts()}.\n"]
        for outcome in (CODE, ASSUMED, DROPPED, RULE, NAME, NOT_NEEDED):
            rows = self.of(outcome)
            if rows:
                lines = [f"| `{row.key}` | {' '.join(row.text.split()).replace('|', '&#124;')} |" for row in rows]
                head = f"## {outcome.capitalize()}: {_MEANINGS[outcome]}\n\n| key | here |\n|---|---|"
                parts.append("\n".join([head, *lines, ""]))
        return "\n".join(parts)


class Section:
    """A mapping of the imported config whose keys are taken one by one; ``finish`` reports the keys in ``left``."""

    def __init__(self, tree: object, key: str, report: ImportReport) -> None:
        if tree is not None and not isinstance(tree, Mapping):
            raise ConfigError(f"{shown(tree)} is not a mapping", key=key, expected="the mapping that Isaac Lab writes")
        self.left: Tree = dict(tree or {})
        self.key, self._report = key, report

    def take(self, name: str, default: object = None) -> Any:
        """Return and remove the value of a key; ``default`` if the key is missing or null."""
        value = self.left.pop(name, None)
        return default if value is None else value

    def section(self, name: str) -> Section:
        return Section(self.take(name), self._key_of(name), self._report)

    def joined(self, name: str) -> Section:
        """Return and remove the mapping of a key, or the union of a list of mappings, as Isaac Lab 3.0 writes it."""
        value = self.left.get(name)
        if isinstance(value, list) and all(isinstance(item, Mapping) for item in value):
            pairs = [pair for item in value for pair in item.items()]
            self.left[name] = {key: setting for key, setting in pairs if key != "func" and not key.startswith("_")}
        return self.section(name)

    def sections(self) -> Iterator[tuple[str, Section]]:
        """Yield and remove all remaining keys that are not null, with their mappings."""
        for name, value in self.items():
            yield name, Section(value, self._key_of(name), self._report)

    def take_if_known(self, names: Iterable[str]) -> Tree:
        """Return and remove the keys in ``names`` that are present and not null."""
        return {name: value for name in names if (value := self.take(name)) is not None}

    def items(self) -> Iterator[tuple[str, object]]:
        """Yield and remove all remaining keys that are not null, with their values."""
        for name in list(self.left):
            value = self.take(name)
            if value is not None:
                yield name, value

    def drop(self, names: Iterable[str], reason: str, outcome: str = DROPPED) -> None:
        """Report the given keys as dropped, except empty ones."""
        for name in names:
            value = self.take(name)
            if value not in (None, {}, [], False, ""):
                self._report.add(self._key_of(name), outcome, f"{shown(value)}: {reason}")

    def finish(self, reason: str = "nothing here corresponds to it", skip: Collection[str] = ()) -> None:
        """Report all remaining keys as dropped, except the duplicates and unused keys in ``skip``."""
        self.drop([name for name in self.left if name not in skip], reason)

    def _key_of(self, name: str) -> str:
        return f"{self.key}.{name}" if self.key else name


def shown(value: object, width: int = 60) -> str:
    """Return a value as short text."""
    text = " ".join(str(value).split())
    return text if len(text) <= width else f"{text[: width - 1]}…"
