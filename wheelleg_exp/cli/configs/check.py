"""``wheelleg check``: report every mistake in a config, and with ``--physics`` implausible numbers."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import UsageError, add_json, add_overrides, print_json
from wheelleg_exp.cli.printing.terminal import print_blocks, print_table
from wheelleg_exp.errors import EXIT_FINDING, EXIT_INPUT, EXIT_OK, ConfigError
from wheelleg_exp.terms.key_syntax import names_pipeline

if TYPE_CHECKING:
    from wheelleg_exp.lint.physics_check import PhysicsReport
    from wheelleg_exp.lint.rule import Finding


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    text = "also check whether the numbers are plausible; exit status 1 with findings"
    parser.add_argument("--physics", action="store_true", help=text)
    parser.add_argument("--all", action="store_true", help="with --physics: also show silenced findings")
    parser.add_argument("--list", action="store_true", help="list the rules of --physics, and check nothing")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Print a config's errors and implausible values; return status 2 for errors, 1 for implausible values, else 0."""
    if args.list:
        from wheelleg_exp.lint.physics_check import RULES

        rules: list[dict[str, object]] = [{"rule": name, "what": rule.summary} for name, rule in RULES.items()]
        if args.json:
            print_json(rules)
        else:
            print_table(("rule", "what it finds"), [list(row.values()) for row in rules])
        return EXIT_OK
    if any(map(names_pipeline, args.overrides)):
        return _check_pipeline(args)
    from wheelleg_exp.config.checking.find_mistakes import find_mistakes

    composed, mistakes = find_mistakes(args.overrides, config_dirs=args.config_dirs)
    if not mistakes and composed is not None and composed.config.get("init_from") is not None:
        from wheelleg_exp.config.config_errors import parts
        from wheelleg_exp.jobs.train.initial_networks import initial_file

        notes: list[str] = []
        try:
            with composed.placing(), initial_file(composed.config, notes.append):
                for line in notes if not args.json else ():
                    print(line)
        except ConfigError as error:
            mistakes = parts(error)
    if mistakes:
        return report_mistakes(mistakes, as_json=args.json)
    assert composed is not None
    if args.physics:
        from wheelleg_exp.lint.physics_check import examine

        report = examine(composed)
        if args.json:
            print_json({"mistakes": [], **report.document()})
        else:
            _show(report, show_all=args.all)
        return EXIT_FINDING if report.open else EXIT_OK
    if args.json:
        print_json({"mistakes": []})
    else:
        for key in composed.terms_without_role:
            print(f"note: left out, because the robot lists no joints or links for it: {key}")
        print(f"no mistakes in the task '{composed.config['task']['name']}'")
    return EXIT_OK


def report_mistakes(mistakes: Sequence[ConfigError], *, as_json: bool) -> int:
    """Print the mistakes in a config as JSON, and return the exit status; otherwise, raise an error that lists them."""
    from wheelleg_exp.config.config_errors import document, raise_all

    if not as_json:
        raise_all(mistakes)
    print_json({"mistakes": [document(error) for error in mistakes]})
    return EXIT_INPUT


def _check_pipeline(args: argparse.Namespace) -> int:
    """For every phase of a training pipeline, check the config, the initial networks, and the pass condition."""
    if args.physics or args.all:
        message = "the option applies only to a single task"
        raise UsageError(message, key="--physics", expected="task=... and the overrides of one phase")
    from wheelleg_exp.cli.train import composed_phases
    from wheelleg_exp.config.config_errors import parts

    try:
        pipeline, _ = composed_phases(args.overrides, args.config_dirs)
    except ConfigError as error:
        return report_mistakes(parts(error), as_json=args.json)
    if args.json:
        print_json({"mistakes": []})
    else:
        phases = ", ".join(f"{name} (task '{phase.task}')" for name, phase in pipeline.phases.items())
        print(f"no mistakes in the pipeline '{pipeline.tree['name']}': {phases}")
    return EXIT_OK


def _show(report: PhysicsReport, *, show_all: bool) -> None:
    from wheelleg_exp.lint.physics_check import facts_rows

    def section(show: Callable[..., None], columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        if rows:
            show(columns, rows)
            print()

    def findings(title: str, found: Sequence[tuple[Finding, str]]) -> None:
        rows = [(f.rule, f.key, f.where or "", f.message, reason) for f, reason in found]
        section(partial(print_blocks, heads=2), ("", "", "place", "what", title), rows)

    section(print_table, ("robot", "", ""), facts_rows(report.case.facts))
    columns = ("reward", "weight", "at a tolerance of", "per step", "per episode", "share")
    section(print_table, columns, report.rewards_table())
    findings("hint", [(finding, finding.hint) for finding in report.open])
    if show_all:
        findings("silenced", [(finding, report.reasons[finding.rule]) for finding in report.silenced])
    for name in report.unused:
        print(f"note: check.silence.{name} silences nothing here")
    count, silent = len(report.open), len(report.silenced)
    more = " (--all shows them)" if silent and not show_all else ""
    print(f"{count} finding{'' if count == 1 else 's'}, {silent} silenced{more}")
