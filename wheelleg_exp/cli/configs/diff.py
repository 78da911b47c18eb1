"""``wheelleg diff A B``: compare two runs, tasks or lists of overrides by meaning."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import add_config_dir, add_json, add_root, offer, print_json
from wheelleg_exp.cli.printing.terminal import print_table
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK
from wheelleg_exp.report.value_format import plain as shown

if TYPE_CHECKING:
    from wheelleg_exp.config.explaining.config_diff import Difference, PlacedChange, Side

_SIDE = "a run (path, id or latest), a task (stand), or overrides in quotes ('task=stand env.decimation=4')"
_WIDEST = 44  # `wheelleg diff` prints at most 44 characters of a config value.


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    offer("run or task", parser.add_argument("a", metavar="A", help=_SIDE))
    offer("run or task", parser.add_argument("b", metavar="B", help="the second run, task, or list of overrides"))
    add_root(parser)
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the differences between two configs; return status 0 for equal configs and 1 for different configs."""
    from wheelleg_exp.config.explaining.config_diff import compare
    from wheelleg_exp.jobs.diff_inputs import load_sides

    a, b = load_sides(args.a, args.b, args.root, args.config_dirs)
    difference = compare(a, b)
    if args.json:
        kinds = {name: [asdict(x) for x in getattr(difference, name)] for name in ("terms", "parameters", "facts")}
        compared = [section for section in a.facts if section in b.facts]
        print_json({"a": a.label, "b": b.label, "equal": not difference, **kinds, "facts_compared": compared})
    else:
        _print(a, b, difference)
    return EXIT_FINDING if difference else EXIT_OK


def _print(a: Side, b: Side, difference: Difference) -> None:
    print(f"A: {a.label}\nB: {b.label}")
    if not difference:
        print("equal by meaning")
        return
    if difference.terms:
        _titled("terms", ("", "term", "A", "B", "note"), list(map(_row, difference.terms)))
    if difference.parameters:
        _titled("parameters", ("", "key", "A", "B"), [_row(change)[:-1] for change in difference.parameters])
    for section in dict.fromkeys(change.section for change in difference.facts):
        facts = [(f.name, _cut(f.a), _cut(f.b)) for f in difference.facts if f.section == section]
        _titled(section, ("", "A", "B"), facts)


def _titled(title: str, columns: tuple[str, ...], rows: Sequence[Sequence[object]]) -> None:
    print(f"\n{title}")
    print_table(columns, rows, heads=2)


def _row(change: PlacedChange) -> tuple[str, ...]:
    places = [f"  ({where})" if where else "" for where in (change.where_a, change.where_b)]
    first = "-" if change.kind == "added" else _brief(change.a) + places[0]
    second = "-" if change.kind == "removed" else _brief(change.b) + places[1]
    return change.kind, change.path, first, second, change.note


def _brief(value: object) -> str:
    """Return a config value as short text; a manager term becomes a text such as ``is_alive weight=1.0``."""
    if isinstance(value, Mapping) and "_target_" in value:
        fields = [f"{key}={shown(value[key])}" for key in ("weight", "mode") if key in value]
        return " ".join([str(value["_target_"]).rsplit(".", 1)[-1], *fields])
    return _cut(value)


def _cut(value: object) -> str:
    text = shown(value)
    return text if len(text) <= _WIDEST else text[: _WIDEST - 1] + "…"
