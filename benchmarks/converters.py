"""Count the USD files of a corpus that each converter turns into the expected MJCF.

    python benchmarks/converters.py --corpus DIR [--tools wheelleg,mujoco-usd,newton] [--only a,b]
                                    [--markdown | --json] [--work DIR]

A corpus is a folder with ``assets``, ``expected/NAME.json`` and a ``check.py`` that compares an MJCF with an
expectation. The environment variable ``WHEELLEG_USD_CORPUS`` can replace ``--corpus``. Each converter gets a separate
Python environment with pinned versions, and converts every asset in a separate process. An MJCF then

    loads     if MuJoCo compiles a model from the MJCF
    coarsely  agrees if bodies, degrees of freedom, total mass, and number of colliders are correct
    unnamed   agrees if everything is correct except the names of bodies, joints, and actuators
    agrees    if everything is correct, including the names
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from converter_tools import TOOLS, BenchmarkError, Run, Tool, convert, interpreter, last_line

from wheelleg_exp.errors import WheellegError, nearest_name
from wheelleg_exp.paths import cache_dir

COLUMNS = ("loads", "coarsely", "unnamed", "agrees")


@dataclass(frozen=True)
class Outcome:
    """The result of one converter for one asset; ``differs`` names the wrong aspects, ``problem`` the first reason."""

    tool: str
    asset: str
    style: str
    loads: bool
    coarsely: bool
    unnamed: bool
    agrees: bool
    differs: tuple[str, ...]
    problem: str
    seconds: float

    @property
    def grade(self) -> str:
        """Return the best grade that the result reaches."""
        return next((word for word in reversed(COLUMNS) if getattr(self, word)), "fails")


# ---------------------------------------------------------------- measuring
def expectations(corpus: Path | None, only: list[str]) -> list[dict[str, Any]]:
    """Return the expected results of the corpus, sorted by asset name.

    Raises:
        BenchmarkError: there is no corpus, or no such asset in it.
    """
    if corpus is None or not (corpus / "check.py").is_file() or not (corpus / "expected").is_dir():
        raise BenchmarkError(
            f"the folder '{corpus}' is not a corpus" if corpus else "the option --corpus is missing",
            key="--corpus",
            expected="a folder with assets, expected/NAME.json and check.py (or WHEELLEG_USD_CORPUS)",
        )
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in corpus.glob("expected/*.json")}
    for name in only:
        if name not in found:
            near = nearest_name(name, found)
            raise BenchmarkError(f"the corpus has no '{name}'", key="--only", nearest=near)
    return [found[name] for name in sorted(only or found)]


def measure(tool: Tool, corpus: Path, wanted: list[dict[str, Any]], work: Path, limit: float) -> list[Outcome]:
    """Convert all assets with one converter, and compare the models with the expected results."""
    python, models = interpreter(tool, work), work / "models" / tool.name
    runs = {}
    for number, item in enumerate(wanted, 1):
        name, source = item["name"], (corpus / item["asset"]).resolve()
        print(f"{tool.name}: {number} of {len(wanted)}, {name}", file=sys.stderr)
        runs[name] = convert(tool, python, source, models / name / f"{name}.xml", item.get("args", []), limit)
    strict, lenient = (_check(corpus, models, list(runs), ignore) for ignore in ("", "names"))
    return [_outcome(tool.name, strict[name], lenient[name], run) for name, run in runs.items()]


def _check(corpus: Path, models: Path, names: list[str], ignore: str) -> dict[str, dict[str, Any]]:
    command = [sys.executable, str(corpus / "check.py"), "--all", str(models), "--only", ",".join(names), "--json"]
    done = subprocess.run([*command, *(["--ignore", ignore] if ignore else [])], capture_output=True, text=True)
    try:
        return {row["name"]: row for row in json.loads(done.stdout)}
    except ValueError:
        raise BenchmarkError(f"the corpus's check.py failed: {last_line(done.stderr)}", key="--corpus") from None


def _outcome(tool: str, strict: dict[str, Any], lenient: dict[str, Any], run: Run) -> Outcome:
    differs = tuple(word for word in strict["differs"] if not word.endswith("~"))
    reasons = [text for aspect in differs for text in strict["findings"].get(aspect, [])]
    return Outcome(
        tool=tool,
        asset=strict["name"],
        style=strict["style"],
        loads=not {"convert", "compiles"} & set(differs),
        coarsely=bool(lenient["agree"] or lenient["basic"]),
        unnamed=bool(lenient["agree"]),
        agrees=bool(strict["agree"]),
        differs=differs,
        problem=run.problem or (reasons[0] if reasons else ""),
        seconds=round(run.seconds, 3),
    )


# ---------------------------------------------------------------- printing
Table = list[list[str]]


def summary(outcomes: list[Outcome]) -> Table:
    """Return the summary table with one row for each converter."""
    rows = [["tool", *COLUMNS, "of", "median s"]]
    for tool in _tools(outcomes):
        mine = [o for o in outcomes if o.tool == tool]
        counts = [str(sum(getattr(o, word) for o in mine)) for word in COLUMNS]
        rows.append([tool, *counts, str(len(mine)), f"{statistics.median(o.seconds for o in mine):.1f}"])
    return rows


def by_style(outcomes: list[Outcome]) -> Table:
    """Return, for each style and converter, how many assets load, agree coarsely, agree except for names, and agree."""
    tools = _tools(outcomes)
    rows = [["style", "assets", *tools]]
    for style in sorted({o.style for o in outcomes}):
        cells = []
        for tool in tools:
            mine = [o for o in outcomes if o.style == style and o.tool == tool]
            cells.append(" / ".join(str(sum(getattr(o, word) for o in mine)) for word in COLUMNS))
        rows.append([style, str(len({o.asset for o in outcomes if o.style == style})), *cells])
    return rows


def by_asset(outcomes: list[Outcome]) -> Table:
    """Return a table with the grade of each asset for each converter."""
    tools = _tools(outcomes)
    found = {(o.asset, o.tool): o for o in outcomes}
    assets = sorted({(o.style, o.asset) for o in outcomes})
    return [
        ["style", "asset", *tools],
        *([style, asset, *(found[asset, tool].grade for tool in tools)] for style, asset in assets),
    ]


def _tools(outcomes: list[Outcome]) -> list[str]:
    return list(dict.fromkeys(o.tool for o in outcomes))


def plain(table: Table) -> str:
    """Return a table with columns of equal width."""
    widths = [max(len(cell) for cell in column) for column in zip(*table, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in table)
    return "\n".join(line.rstrip() for line in lines)


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    head, *rows = ("| " + " | ".join(row) + " |" for row in table)
    return "\n".join([head, "|" + " --- |" * len(table[0]), *rows])


def document(outcomes: list[Outcome]) -> str:
    """Return all tables and the compared versions in Markdown."""
    count = len({o.asset for o in outcomes})
    lines = [f"{count} USD files were converted with Python {platform.python_version()} on {platform.machine()}:", ""]
    lines += [f"- `{tool}`: {TOOLS[tool].version}" for tool in _tools(outcomes)]
    lines += ["", markdown(summary(outcomes)), ""]
    lines += [f"Number of MJCF files by style ({' / '.join(COLUMNS)}):", "", markdown(by_style(outcomes)), ""]
    return "\n".join([*lines, "The strictest criterion that each MJCF file meets:", "", markdown(by_asset(outcomes))])


def text(outcomes: list[Outcome]) -> str:
    """Return all tables for the terminal, and the reason for each asset that does not agree."""
    parts = [plain(summary(outcomes)), f"{' / '.join(COLUMNS)}\n{plain(by_style(outcomes))}", plain(by_asset(outcomes))]
    wrong = [[o.tool, o.asset, " ".join(o.differs), o.problem[:100]] for o in outcomes if not o.unnamed]
    return "\n\n".join([*parts, plain([["tool", "asset", "differs", "first reason"], *wrong])])


# ---------------------------------------------------------------- the command
def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    named = os.environ.get("WHEELLEG_USD_CORPUS")
    parser.add_argument("--corpus", type=Path, default=Path(named) if named else None)
    parser.add_argument("--tools", default=",".join(TOOLS), help="some of " + ", ".join(TOOLS))
    parser.add_argument("--only", default="", help="names of assets, with commas between")
    parser.add_argument("--work", type=Path, default=cache_dir() / "converters", help="environments and models")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for one conversion")
    form = parser.add_mutually_exclusive_group()
    form.add_argument("--markdown", action="store_true")
    form.add_argument("--json", action="store_true")
    return parser.parse_args()


def run(args: argparse.Namespace) -> list[Outcome]:
    """Measure all converters that the command line names."""
    names = [word for word in args.tools.split(",") if word]
    for name in names:
        if name not in TOOLS:
            near = nearest_name(name, TOOLS)
            raise BenchmarkError(f"there is no tool '{name}'", key="--tools", expected=", ".join(TOOLS), nearest=near)
    wanted = expectations(args.corpus, [word for word in args.only.split(",") if word])
    work = args.work.resolve()
    for name in names:  # Create all environments first, because this step fails without a network.
        interpreter(TOOLS[name], work)
    found = (measure(TOOLS[name], args.corpus.resolve(), wanted, work, args.limit) for name in names)
    return [outcome for group in found for outcome in group]


def main() -> int:
    """Measure and print."""
    args = arguments()
    try:
        outcomes = run(args)
    except WheellegError as error:
        print(f"converters: error: {error}", file=sys.stderr)
        return error.exit_code
    if args.json:
        print(json.dumps([{**dataclasses.asdict(o), "grade": o.grade} for o in outcomes], indent=1))
    else:
        print(document(outcomes) if args.markdown else text(outcomes))
    return 0


if __name__ == "__main__":
    sys.exit(main())
