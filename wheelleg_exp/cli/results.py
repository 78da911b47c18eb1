"""``wheelleg results NAME RUN...``: write a table of results to docs/results, or reproduce one."""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path

from wheelleg_exp.cli.arguments import add_config_dir, add_json, add_root, add_stored, print_json
from wheelleg_exp.cli.printing.terminal import shown, tool
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK, WheellegError, nearest_name
from wheelleg_exp.terms.key_syntax import is_override

FOLDER = Path("docs/results")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("name", metavar="NAME", help="the name of the result and of its page")
    text = "runs that differ by their seed, and overrides such as protocol=walk; with --again: names of more "
    text += "results, whose common runs are trained once"
    parser.add_argument("runs", nargs="*", metavar="RUN|OVERRIDE", help=text)
    text = f"the folder of the result (default: {FOLDER})"
    parser.add_argument("--into", type=Path, default=FOLDER, metavar="DIR", help=text)
    text = "evaluate the linear-quadratic reference controller too, and compare"
    parser.add_argument("--reference", action="store_true", help=text)
    add_stored(parser)
    parser.add_argument("--replace", action="store_true", help="replace a result of this name")
    text = "re-run the recorded trainings and evaluations, and compare bit by bit"
    parser.add_argument("--again", action="store_true", help=text)
    add_config_dir(parser)
    add_root(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate runs and write a table of the results; with ``--again``, reproduce an existing table of results."""
    from wheelleg_exp.config.schema import NAME, NAME_WORDS

    if re.fullmatch(NAME, args.name) is None:
        raise WheellegError(f"{args.name!r} is not a valid name for a results page", key="NAME", expected=NAME_WORDS)
    return _again(args) if args.again else _write(args)


def _write(args: argparse.Namespace) -> int:
    from wheelleg_exp.cli.evaluate import Evaluator, found
    from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay
    from wheelleg_exp.jobs.compare_evaluations import compare
    from wheelleg_exp.jobs.result_record import earlier_manifests, require_one_method, write_results

    names = [word for word in args.runs if not is_override(word)]
    words = [word for word in args.runs if is_override(word)]
    if not names:
        raise WheellegError("the command line names no run to evaluate", key="RUN", expected="the runs of the table")
    earlier_manifests(args.name, args.into)  # Raise an error before overwriting a file that is not a results page.
    if (path := args.into / f"{args.name}.json").exists() and not args.replace:
        expected = "another name, or --replace, which removes the old page and its manifests"
        raise WheellegError("there is a result of this name", key=shown(path.absolute()), expected=expected)
    chosen = found(names, args.root)
    require_one_method([run for run, _ in chosen])  # Raise an error for a run that cannot be reproduced.
    with ConsoleDisplay(quiet=True) as display:
        evaluator = Evaluator(args.command, args.config_dirs, args.stored, display.test)
        made = [evaluator.policy(*one, words) for one in chosen]
        reference = evaluator.reference(made[0], words) if args.reference else None
    compared = compare(made, [] if reference is None else [reference], reference, args.command, args.name)
    written = [shown(path.absolute()) for path in write_results(args.name, args.into, compared, made, reference, words)]
    if args.json:
        print_json({"result": args.name, "files": written})
        return EXIT_OK
    print(*written, sep="\n")
    into = "" if args.into == FOLDER else f" --into {args.into}"
    print(f"reproduce: {tool('wheelleg')} results {args.name} --again{into}")
    return EXIT_OK


def _again(args: argparse.Namespace) -> int:
    from wheelleg_exp.jobs.result_record import read_result, reproduce
    from wheelleg_exp.run.run_directory import RunDirectory

    names = list(dict.fromkeys((args.name, *args.runs)))
    if args.reference or args.stored or args.replace:
        message = "the record determines the evaluations"
        raise WheellegError(message, key="--again", expected="--again without options of evaluations")
    pages = sorted(path.stem for path in args.into.glob("*.json"))
    if missing := [name for name in names if name not in pages]:
        message = f"there is no result {' and no '.join(map(repr, missing))} in {args.into}"
        known = ", ".join(pages) or "(there are none)"
        expected = f"names of results with --again, no runs and no overrides: {known}"
        raise WheellegError(message, key="NAME", expected=expected, nearest=nearest_name(missing[0], pages))
    # Read the JSON files of all results first, so that a damaged file raises an error before the first training.
    records = {name: read_result(name, args.into) for name in names}
    verdicts: dict[str, dict[str, object]] = {}
    say = _print_to_stderr if args.json else _print
    trained: dict[str, RunDirectory] = {}
    with tempfile.TemporaryDirectory(prefix="wheelleg-results-") as folder:
        for name, (record, manifests) in records.items():
            found = reproduce(record, manifests, Path(folder), say, args.config_dirs, trained)
            for line in (*found.differences, f"{name}: {found.verdict}"):
                say(line)
            verdicts[name] = {"verdict": found.verdict, "differences": found.differences}
    if args.json:
        print_json({"results": verdicts})
    return EXIT_FINDING if any(found["differences"] for found in verdicts.values()) else EXIT_OK


def _print(text: str) -> None:
    print(text, flush=True)


def _print_to_stderr(text: str) -> None:
    print(text, file=sys.stderr)
