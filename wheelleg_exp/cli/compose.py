"""``wheelleg compose``: print the composed config."""

from __future__ import annotations

import argparse
from typing import Any

from wheelleg_exp.cli.common import add_json, add_overrides, print_json
from wheelleg_exp.config.compose import Composed, compose
from wheelleg_exp.config.diagnose import nearest_path
from wheelleg_exp.config.provenance import Source
from wheelleg_exp.config.tree import dotted, node_paths, select
from wheelleg_exp.errors import EXIT_OK, ConfigError


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_overrides(parser)
    add_json(parser)
    parser.add_argument("--primary", default="train", metavar="NAME", help="the primary config (default: train)")
    parser.add_argument("--package", metavar="KEY", help="print only the part below this key")
    parser.add_argument("--resolve", action="store_true", help="replace ${...} by what it stands for")
    parser.add_argument("--provenance", action="store_true", help="say where each leaf comes from")


def run(args: argparse.Namespace) -> int:
    """Print the config as YAML, as JSON, or leaf by leaf with its place."""
    composed = compose(args.overrides, primary=args.primary, config_dirs=args.config_dirs)
    if args.provenance:
        _print_provenance(composed, args.package, as_json=args.json)
        return EXIT_OK
    tree = _part(_tree(composed, resolve=args.resolve), args.package)
    if args.json:
        print_json(tree)
    else:
        print(_yaml(tree), end="")
    return EXIT_OK


def _tree(composed: Composed, *, resolve: bool) -> Any:
    from omegaconf import OmegaConf

    return OmegaConf.to_container(composed.raw, resolve=resolve)


def _part(tree: Any, package: str | None) -> Any:
    if package is None:
        return tree
    try:
        return select(tree, package)
    except KeyError as error:
        nearest = nearest_path(package, [dotted(path) for path in node_paths(tree)])
        raise ConfigError("there is no such key", key=package, where="--package", nearest=nearest) from error


def _yaml(tree: Any) -> str:
    import yaml

    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    return text.removesuffix("...\n")


def _print_provenance(composed: Composed, package: str | None, *, as_json: bool) -> None:
    _part(_tree(composed, resolve=False), package)
    places = composed.provenance
    sources = places.below(package) if package is not None else list(places.values())
    if as_json:
        print_json({source.path: _document(source) for source in sources})
        return
    for source in sources:
        print(f"{source.path}: {source.value!r}  # {source.where}")
        for hidden in reversed(source.shadowed):
            print(f"  # hides {hidden.path}: {hidden.value!r} ({hidden.where})")


def _document(source: Source) -> dict[str, Any]:
    hidden = [{"path": s.path, "value": s.value, "where": s.where} for s in source.shadowed]
    return {"value": source.value, "where": source.where, "shadowed": hidden}
