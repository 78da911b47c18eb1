"""``wheelleg compose``: print the composed config."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from wheelleg_exp.cli.arguments import (
    add_json,
    add_overrides,
    add_primary,
    offer,
    primary_of,
    print_json,
    source_document,
)
from wheelleg_exp.cli.printing.terminal import hanging, print_table, screen_width
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.composing.hydra_errors import nearest_path
from wheelleg_exp.config.composing.provenance import Source
from wheelleg_exp.config.tree_lookup import node_paths, select
from wheelleg_exp.errors import EXIT_OK, ConfigError, WheellegError
from wheelleg_exp.terms.key_syntax import dotted

if TYPE_CHECKING:
    from wheelleg_exp.config.explaining.term_shapes import GroupShape, TermShape


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    add_json(parser)
    add_primary(parser)
    offer("key", parser.add_argument("--package", metavar="KEY", help="print only the part below this key"))
    parser.add_argument("--resolve", action="store_true", help="replace each ${...} by its value")
    text = "print the place of each leaf, and the values that it replaced"
    parser.add_argument("--provenance", action="store_true", help=text)
    parser.add_argument("--shapes", action="store_true", help="print the layout of observations and actions")


def run(args: argparse.Namespace) -> int:
    """Print the composed config, the file and line that set each value, or the layout of observations and actions."""
    if args.shapes and (args.package or args.resolve or args.provenance):
        expected = "--shapes without --package, --resolve and --provenance"
        message = "the option --shapes cannot be combined with other options"
        raise WheellegError(message, key="--shapes", expected=expected)
    composed = compose(args.overrides, primary=primary_of(args), config_dirs=args.config_dirs)
    if args.shapes:
        _print_shapes(composed, as_json=args.json)
        return EXIT_OK
    if args.provenance:
        _print_provenance(composed, args.package, resolve=args.resolve, as_json=args.json)
        return EXIT_OK
    tree = _part(_tree(composed, resolve=args.resolve), args.package)
    if args.json:
        print_json(tree)
        return EXIT_OK

    import yaml

    # PyYAML writes some lines longer than ``width``, so a width of 72 keeps most lines below 80 characters.
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, default_flow_style=None, width=72)
    print(text.removesuffix("...\n"), end="")
    return EXIT_OK


def _tree(composed: Composed, *, resolve: bool) -> object:
    from omegaconf import OmegaConf

    return OmegaConf.to_container(composed.raw, resolve=resolve)


def _part(tree: object, package: str | None) -> object:
    if package is None:
        return tree
    try:
        return select(tree, package)
    except KeyError as error:
        nearest = nearest_path(package, [dotted(path) for path in node_paths(tree)])
        message = "the config has no key with this name"
        raise ConfigError(message, key=package, where="--package", nearest=nearest) from error


def _print_provenance(composed: Composed, package: str | None, *, resolve: bool, as_json: bool) -> None:
    places = composed.provenance
    deleted = places.deleted_below(package or "")
    if not deleted:
        _part(_tree(composed, resolve=False), package)
    values, sources = _tree(composed, resolve=resolve), places.below(package or "")
    if as_json:
        found = {source.path: _document(source, select(values, source.path)) for source in sources}
        print_json({**found, **{source.path: {**_document(source, None), "deleted": True} for source in deleted}})
        return
    texts = [(source, f"{source.path}: {select(values, source.path)!r}") for source in sources]
    texts += [(source, f"# {source.path}: removed") for source in deleted]
    for source, text in texts:
        _print_line(text, f"  # {source.where}")
        for hidden in reversed(source.shadowed):
            _print_line(f"  # hides {hidden.path}: {hidden.value!r}", f" ({hidden.where})")


def _print_line(text: str, place: str) -> None:
    """Print a config value and the place that set the value, on one line, or on two lines in a narrow terminal."""
    line = text + place
    print(line if len(line) <= screen_width() else f"{hanging(text, 4)}\n    {place.lstrip()}")


def _document(source: Source, value: object) -> dict[str, object]:
    return {**source_document(source), "value": value, "shadowed": [source_document(s) for s in source.shadowed]}


def _print_shapes(composed: Composed, *, as_json: bool) -> None:
    from wheelleg_exp.config.checking.find_mistakes import require_valid
    from wheelleg_exp.config.explaining.term_shapes import shapes

    require_valid(composed)
    found = shapes(composed)
    if as_json:
        groups = {name: _group_document(group) for name, group in found.observations.items()}
        print_json({"joints": list(found.joints), "observations": groups, "actions": _group_document(found.actions)})
        return
    for name, group in found.observations.items():
        size = _size(group.shape) if group.shape else ""
        print(f"observations.{name}: {size or 'one tensor for each term'}")
        rows = [(t.name, _last(t.target), t.width, t.history or "-", _size(t.shape), _place(t)) for t in group.terms]
        total = ("total", "", sum(term.width for term in group.terms), "", size, "")
        print_table(("term", "target", "width", "history", "shape", "indices"), [*rows, total])
        print()
    print(f"actions: {_size(found.actions.shape or ())}")
    actions = [(t.name, _last(t.target), t.width, _place(t), " ".join(t.joints)) for t in found.actions.terms]
    print_table(("term", "target", "width", "indices", "joints"), actions)


def _last(target: str) -> str:
    return target.rsplit(".", 1)[-1]


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _place(term: TermShape) -> str:
    return "-" if term.start is None or term.stop is None else f"{term.start}..{term.stop - 1}"


def _group_document(group: GroupShape) -> dict[str, object]:
    terms = {term.name: {k: v for k, v in asdict(term).items() if k != "name"} for term in group.terms}
    return {"shape": group.shape, "terms": terms}
