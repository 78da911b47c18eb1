"""Writes the pages that are made from the files themselves: reference.md, terms.md, rules.md, figures.md, isaaclab.md.

    python docs/make_reference.py

The reference goes through every stock YAML file with the comments beside its keys; where a key has none, the docstring
of whatever reads it speaks. A test holds the pages against the files.
"""

from __future__ import annotations

import runpy
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import yaml

from wheelleg_exp.config import keys as known
from wheelleg_exp.config.composing.headers import package_header
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.explaining.catalog import Entry, library
from wheelleg_exp.config.explaining.docstrings import comment_at, headline
from wheelleg_exp.config.tree import Keys, build, dotted, leaves, line_table
from wheelleg_exp.definitions import drive, recorded, rollout, training
from wheelleg_exp.definitions.definition import Definition
from wheelleg_exp.lint.examine import RULES
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.terms.binding import TARGET, resolve_target

NOTE = "<!-- Made by docs/make_reference.py from the files themselves. Change those, then run it again. -->\n"
FOLDER = Path(__file__).resolve().parent
MOUNTS = {  # where a term file of each group stands when a task mounts it
    "action": "env.actions",
    "command": "env.commands",
    "curriculum": "env.curriculum",
    "event": "env.events",
    "observation": "env.observations.policy.terms",
    "recorder": "env.recorders",
    "reward": "env.rewards",
    "sensor": "env.scene.sensors",
    "termination": "env.terminations",
}


def pages() -> dict[str, str]:
    """Return the text of each page by its file name."""
    return {"reference.md": _reference(), "terms.md": _terms(), "rules.md": _rules(), "figures.md": _figures()}


def _reference() -> str:
    parts = [
        "# Every stock file\n",
        NOTE,
        "What stands in each file of `configs/`, by group. `wheelleg explain KEY` says the same of one key of a",
        "composed config, with the place of every value; [config.md](config.md) tells how the parts work together.\n",
    ]
    names = catalog.groups()
    parts.append(" · ".join(f"[{name}](#{name})" for name in names) + "\n")
    for primary in sorted(configs_dir().glob("*.yaml")):
        parts += _file(Entry("", primary.stem, "", primary))
    for name in names:
        parts.append(f"## {name}\n")
        for entry in catalog.options(name):
            parts += _file(entry)
    return "\n".join(parts).rstrip() + "\n"


def _file(entry: Entry) -> Iterator[str]:
    """Yield the heading, the comment and the table of one file."""
    content = yaml.safe_load(entry.file.read_text(encoding="utf-8")) or {}
    relative = entry.file.relative_to(configs_dir()).as_posix()
    title = f"`{entry.group}={entry.name}`" if entry.group else f"`{entry.name}.yaml`"
    yield f"### {title}\n"
    yield f"{_top_comment(entry.file)} [`{relative}`](../configs/{relative})\n"
    rows = [
        f"| `{dotted(keys)}` | `{_value(value)}` | {_cell(_meaning(entry, content, keys))} |"
        for keys, value in leaves(content)
        if keys and keys[0] not in ("defaults", "hydra")
    ]
    if rows:
        yield "\n".join(["| key | value | meaning |", "|---|---|---|", *rows]) + "\n"


def _top_comment(file: Path) -> str:
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        if "@package" not in line:
            lines.append(line.lstrip("# ").strip())
    return " ".join(lines)


def _meaning(entry: Entry, content: dict[str, Any], keys: Keys) -> str:
    """Return the comment beside a key, else what its reader's docstring says, else the comment of what it is in."""
    if keys[-1] == TARGET:
        return _headline(str(known.at(content, keys)))
    prefix = _package(entry)
    slot = known.slot(build({(*prefix, *k): v for k, v in leaves(content)}), (*prefix, *keys))
    above = (_comment(entry.file, keys[:length]) for length in range(len(keys) - 1, 0, -1))
    return _comment(entry.file, keys) or (slot.meaning if slot else "") or next(filter(None, above), "")


def _comment(file: Path, keys: Keys) -> str:
    line = line_table(file).get(keys)
    return comment_at(file, line) if line else ""


def _headline(target: str) -> str:
    """Return the first line of a target's docstring."""
    return headline(resolve_target(target, "docs"))


def _package(entry: Entry) -> Keys:
    header = package_header(entry.file)
    if header == "_global_" or not entry.group:
        return ()
    return tuple((header or MOUNTS.get(entry.group.split("/")[0], entry.group)).split("."))


def _value(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10**6, allow_unicode=True)
    return text.removesuffix("...\n").strip().replace("|", "\\|")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _terms() -> str:
    parts = ["# The term library\n", NOTE, "Every term that a config may name, with what it takes. Those with a stock"]
    parts.append("file can be selected by its name; any other needs a YAML node of its own ([recipes](recipes.md)).\n")
    stock: dict[Any, list[str]] = {}  # by what is called: a term may have two names
    for entry in catalog.terms():
        stock.setdefault(resolve_target(str(entry.target), "docs"), []).append(f"`{entry.name}`")
    for section, terms in groupby(library(), key=lambda term: term.section):
        parts.append(f"## {section}\n\n| term | stock file | takes | what it is | limits |\n|---|---|---|---|---|")
        for term in terms:
            name = term.target.removeprefix("wheelleg_exp.mdp.")
            files = ", ".join(stock.get(resolve_target(term.target, "docs"), []))
            signature = f"`{_cell(term.signature)}`" if term.signature else ""
            limits = "; ".join(f"`{parameter}`: {_cell(words)}" for parameter, words in term.limits.items())
            parts.append(f"| `{name}` | {files} | {signature} | {_cell(term.help)} | {limits} |")
        parts.append("")
    return "\n".join(parts).rstrip() + "\n"


def _rules() -> str:
    parts = ["# What `wheelleg check --physics` looks at\n", NOTE]
    parts += ["Each rule can be silenced by its name, with a reason: `check.silence.<rule>: reason`.\n"]
    parts += ["| rule | finds | why, and the source |", "|---|---|---|"]
    for rule in RULES.values():
        reason = rule.text.partition("\n")[2]
        parts.append(f"| `{rule.name}` | {_cell(rule.summary)} | {_cell(reason)} |")
    return "\n".join(parts) + "\n"


def _figures() -> str:
    parts = ["# What each figure means\n", NOTE]
    parts.append("Where a label stands in several tables, the title or the column `of` beside it says of what it is.\n")
    parts.append("## Plays and agents\n")
    parts.append("`wheelleg play`, `zero-agent`, `random-agent`; `figures.json`; the manifest's additions; the report.")
    parts += [f"{rollout.ABOUT}\n", *_definitions(rollout.FIGURES)]
    parts += [f"{rollout.MOTION_ABOUT}\n", *_definitions(rollout.MOTION)]
    parts += [f"{rollout.CONTACTS_ABOUT}\n", *_definitions(rollout.CONTACTS)]
    parts.append("## Drives\n")
    parts.append("`wheelleg play RUN --drive` and `--script`; `figures.json`; the manifest's additions.")
    parts += [f"{drive.ABOUT}\n", *_definitions(drive.FIGURES)]
    parts.append("## Scalars of a training\n")
    parts.append(
        "`iterations.jsonl`, TensorBoard, the recording's `training/…`, the manifest's results, plots, the report."
    )
    parts += [f"{training.ABOUT}\n", *_definitions(training.SCALARS)]
    parts += ["In the manifest besides:\n", *_definitions(training.MANIFEST)]
    parts += ["`wheelleg list runs`:\n", *_definitions(training.LISTED)]
    parts.append("## What a recording tells\n")
    parts.append("The tables of `wheelleg inspect` and those of a report; the keys are those of `--json`.")
    parts.append(f"{recorded.ABOUT}\n")
    for title, table in recorded.TABLES.items():
        parts += [f"### {title.capitalize()}\n", *_definitions(table)]
    return "\n".join(parts).rstrip() + "\n"


def _definitions(found: Mapping[str, Definition]) -> Iterator[str]:
    rows = [
        f"| {_cell(d.label).replace('<', '&lt;')} | `{key}` | {d.unit} | {_cell(d.meaning)} |"
        for key, d in found.items()
    ]
    yield "\n".join(["| figure | key | unit | is |", "|---|---|---|---|", *rows]) + "\n"


def main() -> None:
    """Write the pages beside this file."""
    for name, text in pages().items():
        (FOLDER / name).write_text(text, encoding="utf-8")
    runpy.run_path(str(FOLDER / "make_isaaclab.py"), run_name="__main__")


if __name__ == "__main__":
    main()
