"""``wheelleg compose``: print the composed config, or the layout of a policy's observations and actions."""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass

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
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.tree_lookup import node_paths, select
from wheelleg_exp.errors import EXIT_OK, ConfigError, WheellegError
from wheelleg_exp.terms.key_syntax import dotted


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
    primary = primary_of(args, "--shapes" if args.shapes else "")
    composed = compose(args.overrides, primary=primary, config_dirs=args.config_dirs)
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

    # PyYAML writes some lines longer than ``width``, so a width of 64 keeps all lines below 100 characters.
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, default_flow_style=None, width=64)
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


@dataclass(frozen=True)
class TermShape:
    """One term of an observation group, or one action term.

    ``width`` is the number of components of the observation or action in one control step. ``history`` is the number of
    control steps that an observation term stores; 0 means only the present control step. The term's components
    are the slice ``start:stop`` of the observation or action vector; None if there is no such slice. ``joints``
    contains the joints that an action term drives, in the order of the term's components.
    """

    name: str
    target: str
    width: int
    history: int
    shape: tuple[int, ...]
    start: int | None
    stop: int | None
    joints: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroupShape:
    """The layout of an observation group, or of all actions.

    ``shape`` is the shape of the concatenated terms without the environment dimension; None without concatenation.
    """

    terms: tuple[TermShape, ...]
    shape: tuple[int, ...] | None


@dataclass(frozen=True)
class Shapes:
    """The layout of a policy's inputs and outputs; ``joints`` contains the joint names in the robot's default order."""

    joints: tuple[str, ...]
    observations: dict[str, GroupShape]
    actions: GroupShape


def shapes(composed: Composed) -> Shapes:
    """Return the layout of the observations and actions that a config describes."""
    from wheelleg_exp.build import build_env

    config = {**composed.config, "env": {**composed.config["env"], "num_envs": 1}}
    with composed.placing():
        env = build_env(config, composed.asset_roots)
    groups, observations = {}, env.observation_manager
    for group in observations.active_terms:
        dims, terms = observations.group_obs_dim[group], []
        parts = observations.term_parts(group) if isinstance(dims, tuple) else {}
        for name, term in observations.terms(group).items():
            places = parts.get(name, ())
            begin, end = (places[0].start, places[0].stop) if len(places) == 1 else (None, None)
            shape = TermShape(name, term.term.target, term.width, term.history_length, tuple(term.shape), begin, end)
            terms.append(shape)
        groups[group] = GroupShape(tuple(terms), dims if isinstance(dims, tuple) else None)
    manager = env.action_manager
    made, start = [], 0
    for name, width in zip(manager.active_terms, manager.action_term_dim, strict=True):
        target = manager.get_term_cfg(name).target
        joints = tuple(getattr(manager.get_term(name), "joint_names", ()))
        made.append(TermShape(name, target, width, 0, (width,), start, start + width, joints))
        start += width
    return Shapes(tuple(env.scene.robot.joint_names), groups, GroupShape(tuple(made), (manager.total_action_dim,)))


def _print_shapes(composed: Composed, *, as_json: bool) -> None:
    from wheelleg_exp.config.checking.find_mistakes import check

    if mistakes := check(composed):
        raise_all(mistakes)
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
