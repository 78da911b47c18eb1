"""The two sides that ``wheelleg diff`` compares: each is a run, a task, or a list of overrides."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from wheelleg_exp.config.composing.compose import Composed, apply_overrides, compose
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.explaining.config_diff import Side
from wheelleg_exp.config.tree_lookup import line_table
from wheelleg_exp.errors import RunDirectoryError, WheellegError, nearest_name
from wheelleg_exp.jobs.train.source_roots import source_roots
from wheelleg_exp.paths import find_asset
from wheelleg_exp.run import environment, run_config
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_directory import LATEST, RunDirectory
from wheelleg_exp.run.source_changes import SourceRecord
from wheelleg_exp.run.source_snapshot import snapshot_source
from wheelleg_exp.terms.key_syntax import dotted, is_override, split_path
from wheelleg_exp.verify.run_differences import source_of

# ``SECTIONS`` names the config sections that can change the numbers that a training computes.
SECTIONS = ("seed", "task", "env", "agent", "recording")
_CODE = ("commit", "tree", "dirty", "patch_sha256")


def load_sides(a: str, b: str, root: Path, config_dirs: Sequence[Path] = ()) -> tuple[Side, Side]:
    """Load two inputs of ``wheelleg diff``: each is a run (path, id, or ``latest``), a task, or a list of overrides.

    If only one input is a run, it is compared with this machine's source code, package versions, and hardware.
    """
    (one, composed), (other, composed_too) = (_load(text, root, config_dirs) for text in (a, b))
    if composed is not None and other.facts:
        one = replace(one, facts=_facts_here(composed))
    if composed_too is not None and one.facts:
        other = replace(other, facts=_facts_here(composed_too))
    return one, other


def _load(text: str, root: Path, config_dirs: Sequence[Path]) -> tuple[Side, Composed | None]:
    """Load one input of ``wheelleg diff``; for a task or overrides, also return the composed config."""
    words = split_words(text)
    first, rest = (words[0], words[1:]) if words else ("", [])
    if words and (Path(first) / MANIFEST_NAME).is_file():
        return _run(RunDirectory.open(first, root), rest), None
    if words and not is_override(first):
        tasks = [entry.name for entry in catalog.options("task", config_dirs)]
        if first not in tasks:
            try:
                run = RunDirectory.open(first, root)
            except RunDirectoryError as error:
                message = f"neither a task nor a run: {error.message}"
                expected = f"a task ({', '.join(tasks)}), overrides (key=value), a run's path or id, or '{LATEST}'"
                nearest = nearest_name(first, tasks) or error.nearest
                raise RunDirectoryError(message, key=first, expected=expected, nearest=nearest) from error
            return _run(run, rest), None
        words = [f"task={first}", *rest]
    composed = compose(words, config_dirs=config_dirs)
    tree = {section: composed.config[section] for section in SECTIONS if section in composed.config}
    places = composed.provenance
    lists = {mount.package: mount.choices[-1].where for mount in composed.mounts if mount.several}

    def where(path: str) -> str | None:
        if path in lists:
            return lists[path]
        found = places.below(path) or places.deleted_below(path)
        return found[0].where if found else lists.get(dotted(split_path(path)[:-1]))

    return Side(text or "(no overrides)", tree, where), composed


def split_words(text: str) -> list[str]:
    """Split a command line into words at spaces, except at spaces inside the quotes or brackets of an override."""
    words, quote, depth = [""], "", 0
    for letter in text:
        if letter.isspace() and not quote and not depth:
            words.append("")
            continue
        words[-1] += letter
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        else:
            depth += (letter in "([{") - (letter in ")]}")
    if quote or depth > 0:
        message = "the command line has an unclosed quote or bracket"
        raise WheellegError(message, key=text, expected="closed quotes and brackets")
    return [word for word in words if word]


def _run(run: RunDirectory, overrides: Sequence[str]) -> Side:
    env, agent = run_config.load_params(run)
    facts = run.manifest().facts
    sections: dict[str, object] = {"task": {"name": facts.task}, **({"seed": facts.seeds[0]} if facts.seeds else {})}
    if (run.path / run_config.CONFIG).is_file():
        # Ignore a saved config with an interpolation that OmegaConf cannot resolve.
        with suppress(RunDirectoryError):
            recorded = run_config.recorded_config(run, facts.config_variables or {})
            sections |= {key: value for key, value in recorded.items() if key in SECTIONS and value is not None}
    tree = apply_overrides({**sections, "env": env, "agent": agent}, overrides)
    typed = [*run_config.recorded_overrides(run), *overrides]

    def where(path: str) -> str | None:
        for text in reversed(typed):
            keys = split_path(text.lstrip("+~").split("=", 1)[0])
            if keys and split_path(path)[: len(keys)] == keys:  # An override of a config key also sets all child keys.
                return f"override {text}"
        part, *inside = split_path(path)
        if part not in run_config.PARTS:
            return run_config.CONFIG
        line = line_table(run.params / f"{part}.yaml").get(tuple(inside))
        return None if line is None else f"params/{part}.yaml:{line}"

    label = f"{run.path.parent.name}/{run.id}"
    return Side(" ".join([label, *overrides]), {key: tree[key] for key in SECTIONS if key in tree}, where, _facts(run))


def _facts(run: RunDirectory) -> dict[str, Mapping[str, object]]:
    manifest = run.manifest()
    facts = manifest.facts
    robot = run_config.recorded_robot(run) if (run.path / run_config.ROBOT).is_file() else None
    return {
        "code": _code(source_of(run, manifest)),
        "versions": facts.versions or {},
        "hardware": facts.hardware or {},
        "threads": facts.threads or {},
        "variables": facts.environment_variables or {},
        "asset": {**robot.sources, "compiled model": robot.model_sha256} if robot else {"compiled model": None},
    }


def _code(records: Sequence[SourceRecord]) -> dict[str, object]:
    """Return the git state of a run's source folders, such as ``commit``, or ``commit (2)`` for the second folder."""
    found: dict[str, object] = {}
    for number, record in enumerate(records, start=1):
        mark = f" ({number})" if number > 1 else ""
        found |= {f"{key}{mark}": getattr(record, key) for key in _CODE}
        found |= {f"{path}{mark}": states[1] for path, states in (record.contents or {}).items()}
    return found


def _facts_here(composed: Composed) -> dict[str, Mapping[str, object]]:
    """Return this machine's source code state, package versions, and hardware, and the hashes of the robot's files."""
    from wheelleg_exp.asset.conversion_cache import find_extra_files, source_digest

    with tempfile.TemporaryDirectory() as folder:
        records = snapshot_source(source_roots(composed), Path(folder))
    try:
        env, roots = composed.config["env"], composed.asset_roots
        layers = source_digest(find_asset(env["robot"]["asset"], roots), extra_files=find_extra_files(env, roots))
    except WheellegError:
        layers = {}
    code = _code(records)
    return {"code": code, "versions": environment.versions(), "hardware": environment.hardware(), "asset": layers}
