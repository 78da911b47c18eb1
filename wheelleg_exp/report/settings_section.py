"""Report section on settings: the differences between the run's config and its task's defaults, and their origin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.explaining.config_diff import ABSENT, changes, same
from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.report.page_blocks import Block, Cell, Code, More, Note, Table, Text
from wheelleg_exp.report.report_subject import AGENT, Subject
from wheelleg_exp.report.value_format import brief, counted
from wheelleg_exp.terms.key_syntax import Keys, dotted

_PARTS = ("env", "agent")
_NOT_SET, _THEN = "not set", "the configs at the time of the run"
_ROWS = 200
_NOT_COMPOSED = ("hydra", "${", "..")
_LETTERS = 20_000


def settings_blocks(subject: Subject) -> list[Block]:
    """Return tables of a run's overrides, its changes to the task's defaults, and values of the user's YAML files."""
    found: list[Block] = [Text("Nothing was changed on the command line.")]
    if subject.overrides is None:
        found = [Note("The overrides on the command line were not recorded.", "")]
    elif subject.overrides:
        label = f"{counted(len(subject.overrides), 'override')} on the command line:"
        found = [Code("\n".join(subject.overrides), label)]
    try:
        default, again = _composed(subject)
    except WheellegError as error:
        return [*found, Note(f"The task cannot be composed here, so only the overrides are listed: {error.message}.")]
    rows = list(_differences(subject, default, again))
    if rows:
        columns = ("Key", "Default", "This run", "Set by")
        shown = Table("Values that differ from the task's defaults", columns, rows[:_ROWS])
        more = f"{counted(len(rows), 'value')} differ; the first {_ROWS}"
        found.append(shown if len(rows) <= _ROWS else More(more, [shown]))
    else:
        found.append(Text("Every other value is the task's current default."))
    found.append(Text("Compared are env and agent. The seed is listed above; recording and run decide no number."))
    sources = [source for source in again.provenance.values() if source.file is not None] if again else []
    folders = again.config_dirs if again else ()
    own = [source for source in sources if any(Path(str(source.file)).is_relative_to(folder) for folder in folders)]
    if own:
        texts = [(source.path, brief(source.value), source.where) for source in own[:_ROWS]]
        rows = [[Cell(text, code=True) for text in row] for row in texts]
        table = Table("Values set by the user's files", ("Key", "Value", "Set by"), rows, titled=False)
        found.append(More(f"{counted(len(own), 'value')} set by files outside the stock configs", [table]))
    return found


def _differences(subject: Subject, default: Composed, again: Composed | None) -> Iterator[list[Cell]]:
    """Yield a row for each parameter that differs from ``default``; ``again`` is the run's config, composed here."""
    for part in _PARTS:
        if subject.config.get(part):
            for change in changes(default.config.get(part), subject.config[part], same, (part,)):
                texts = [_NOT_SET if value is ABSENT else brief(value) for value in (change.a, change.b)]
                origin = _origin(again, change.keys, change.b, ABSENT in (change.a, change.b))
                yield [*(Cell(text, code=True) for text in (change.key, *texts)), Cell(origin)]


def _composed(subject: Subject) -> tuple[Composed, Composed | None]:
    folders = list(subject.config_dirs)
    task = str(subject.choices.get("task") or subject.task)
    if subject.status == AGENT:
        task = str(subject.setting("task.name") or task)
    words = subject.overrides or []
    _require_harmless([task])
    default = compose([f"task={task}"], config_dirs=folders)
    try:
        _require_harmless(words)
        return default, compose(words, config_dirs=folders) if words else default
    except WheellegError:
        return default, None


def _require_harmless(words: Sequence[str]) -> None:
    """Raise ConfigError if a run's Hydra arguments would make Hydra read folders, modules, or environment variables."""
    if sum(map(len, words)) > _LETTERS or any(part in word for word in words for part in _NOT_COMPOSED):
        raise ConfigError("Hydra does not compose the run's overrides: they could read files outside config folders")


def _origin(again: Composed | None, keys: Keys, value: object, one_sided: bool) -> str:
    # The origin of a config value is known only if Hydra composes an equal value on this machine.
    if again is None:
        return _THEN
    node: object = again.config
    for key in keys:
        node = node.get(key, ABSENT) if isinstance(node, Mapping) else ABSENT
    if (node is ABSENT) != (value is ABSENT) or (node is not ABSENT and not same(node, value)):
        return _THEN
    places, path = again.provenance, dotted(keys)
    found = places.below(path) or places.deleted_below(path)
    mounts = [m for m in again.mounts if m.several and m.package == dotted(keys[:-1])] if one_sided else []
    chosen = str(mounts[0].choices[-1].where) if mounts and mounts[0].choices else None
    if chosen is not None and (not found or chosen.startswith("override")):
        return chosen
    return found[0].where if found else _THEN
