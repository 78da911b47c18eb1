"""``wheelleg diff A B``: compare two runs, tasks or lists of overrides by meaning."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.arguments import add_config_dir, add_json, add_root, print_json
from wheelleg_exp.cli.printing.terminal import print_table
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK
from wheelleg_exp.report.value_format import plain as shown

if TYPE_CHECKING:
    from wheelleg_exp.config.explaining.config_diff import Difference, PlacedChange, Side

_SIDE = "a run (path, id or latest), a task (stand), or overrides in quotes ('task=stand env.decimation=4')"
_WIDEST = 44  # the most characters of a value; a longer one is cut


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("a", metavar="A", help=_SIDE)
    parser.add_argument("b", metavar="B", help="the second one, in the same form")
    add_root(parser)
    add_config_dir(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print the differences; return 0 for equal, 1 for different."""
    from wheelleg_exp.config.explaining.config_diff import compare
    from wheelleg_exp.jobs.diff_inputs import load_sides

    a, b = load_sides(args.a, args.b, args.root, args.config_dirs)
    difference = compare(a, b)
    if args.json:
        print_json(_document(a, b, difference))
    else:
        _print(a, b, difference)
    return EXIT_FINDING if difference else EXIT_OK


def _document(a: Side, b: Side, difference: Difference) -> dict[str, Any]:
    return {
        "a": a.label,
        "b": b.label,
        "equal": not difference,
        "terms": [asdict(change) for change in difference.terms],
        "parameters": [asdict(change) for change in difference.parameters],
        "facts": [asdict(change) for change in difference.facts],
        "facts_compared": [section for section in a.facts if section in b.facts],
    }


def _print(a: Side, b: Side, difference: Difference) -> None:
    print(f"A: {a.label}\nB: {b.label}")
    if not difference:
        print("equal by meaning")
        return
    if difference.terms:
        rows = [_row(change) for change in difference.terms]
        _titled("terms", ("", "term", "A", "B", "note"), rows)
    if difference.parameters:
        rows = [_row(change)[:-1] for change in difference.parameters]
        _titled("parameters", ("", "key", "A", "B"), rows)
    for section in dict.fromkeys(change.section for change in difference.facts):
        facts = [(f.name, _cut(f.a), _cut(f.b)) for f in difference.facts if f.section == section]
        _titled(section, ("", "A", "B"), facts)


def _titled(title: str, columns: tuple[str, ...], rows: list[Any]) -> None:
    print(f"\n{title}")
    print_table(columns, rows, heads=2)


def _row(change: PlacedChange) -> tuple[str, ...]:
    first = "-" if change.kind == "added" else _placed(change.a, change.where_a)
    second = "-" if change.kind == "removed" else _placed(change.b, change.where_b)
    return change.kind, change.path, first, second, change.note


def _placed(value: Any, where: str | None) -> str:
    return _brief(value) + (f"  ({where})" if where else "")


def _brief(value: Any) -> str:
    """Return a value on one line; for a term, the name of its target and its weight or mode."""
    if isinstance(value, Mapping) and "_target_" in value:
        fields = [f"{key}={shown(value[key])}" for key in ("weight", "mode") if key in value]
        return " ".join([str(value["_target_"]).rsplit(".", 1)[-1], *fields])
    return _cut(value)


def _cut(value: Any) -> str:
    text = shown(value)
    return text if len(text) <= _WIDEST else text[: _WIDEST - 1] + "…"
