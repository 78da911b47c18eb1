"""``wheelleg explain KEY``: print the value of a key, the places that set it, its meaning, and the accepted values."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping

from wheelleg_exp.cli.arguments import (
    UsageError,
    add_json,
    add_overrides,
    add_primary,
    offer,
    primary_of,
    print_json,
    source_document,
)
from wheelleg_exp.cli.printing.terminal import hanging, screen_width
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.provenance import Mount
from wheelleg_exp.config.explaining.explanation import Explanation, explain_key
from wheelleg_exp.config.explaining.json_schema import DRAFT, json_schema
from wheelleg_exp.config.key_slots import section_of
from wheelleg_exp.errors import EXIT_OK
from wheelleg_exp.report.value_format import plain as shown
from wheelleg_exp.terms.key_syntax import is_override, split_path

_LABEL = 14
_HEADS = {"not selected": "a term that is not selected", "group": "a group", "term": "a term", "section": "a section"}
_NODES = ("term", "section")
_SHOWN = 24  # `wheelleg explain` prints at most 24 values or keys of a list.


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a key, set or not (env.sim.dt), or a group (robot)"
    offer("key", parser.add_argument("key", nargs="?", metavar="KEY", help=text))
    text = "print the JSON Schema of the config that 'compose --resolve --json' prints, or of its part KEY"
    parser.add_argument("--schema", action="store_true", help=text)
    add_overrides(parser)
    add_json(parser)
    add_primary(parser)


def run(args: argparse.Namespace) -> int:
    """Print the explanation of a config key; users can type the key before, between, or after overrides."""
    words = [word for word in (args.key, *args.overrides) if word is not None]
    keys = [index for index, word in enumerate(words) if not is_override(word)]
    if not words and not args.schema:
        raise UsageError("the argument is missing", key="KEY")
    key = "" if args.schema and not keys else words.pop(keys[0] if len(keys) == 1 else 0)
    args.overrides = words
    composed = compose(words, primary=primary_of(args, key), config_dirs=args.config_dirs)
    if args.schema:  # Explain the key first, because an unknown key is an error.
        part = split_path(explain_key(composed, key).key) if key else ()
        print_json({"$schema": DRAFT, **json_schema(composed.config, part)})
        return EXIT_OK
    explained = explain_key(composed, key)
    if args.json:
        print_json(document(explained))
        return EXIT_OK
    for line in text(explained):
        blanks = len(line) - len(line.lstrip())
        # Align the later lines of a wrapped text with the start of the text in the first line, behind the label.
        print(hanging(line, {0: 4, 2: _LABEL}.get(blanks, blanks + 4)) if len(line) > screen_width() else line)
    return EXIT_OK


def text(explained: Explanation) -> Iterator[str]:
    """Yield the lines of text that explain a config key."""
    if explained.kind == "removed":
        yield f"{explained.key}: removed by {explained.sources[-1].where}"
    elif explained.kind == "not set":
        default = f"default {shown(explained.value)}" if explained.has_value else "it has no default"
        yield f"{explained.key}: not set; {default}"
    elif explained.kind in _HEADS and (explained.kind not in _NODES or isinstance(explained.value, Mapping)):
        yield f"{explained.key}: {_HEADS[explained.kind]}"
    else:
        yield f"{explained.key} = {shown(explained.value)}"
    if not explained.is_read:
        yield "  warning     nothing reads this key"
    if explained.unit:
        yield f"  unit        {explained.unit}"
    for note in explained.meanings:
        label = "meaning" if note.about == "key" else "term"
        yield f"  {label:<11} {note.text}  [{note.where}]"
    yield from _allowed(explained)
    if explained.raw is not None:
        yield f"  written     {shown(explained.raw)}"
    for reference in explained.references:
        written = f", written {shown(reference.raw)}" if reference.raw is not None else ""
        yield f"  refers to   {reference.path} = {shown(reference.value)}{written}  ({reference.where})"
    yield from _sources(explained)
    for name, node in explained.children:
        inner = node.get("_target_", "{...}") if isinstance(node, Mapping) else shown(node)
        gone = node is None and section_of((*split_path(explained.key), name)) is not None
        yield f"    {name}: {'removed' if gone else inner}"
    if explained.mount is not None:
        yield from _mount(explained, explained.mount)


def _allowed(explained: Explanation) -> Iterator[str]:
    other = explained.alternatives
    if explained.kind in _NODES:
        if other.keys:
            yield "  not set     " + _cut([f"{name}={shown(default)}" for name, default in other.keys])
        return
    if other.type and not (other.values and other.type.startswith("one of ")):
        yield "  type        " + ", ".join([other.type, *other.limits])
    if other.values:
        yield "  values      " + _cut([shown(value) for value in other.values])
    if other.has_default and explained.kind == "value":
        yield f"  default     {shown(other.default)}"


def _sources(explained: Explanation) -> Iterator[str]:
    if not explained.sources:
        return
    yield "  set by (the last one counts):" if explained.kind != "removed" else "  set by, then removed:"
    width = max(len(source.where) for source in explained.sources)
    for source in explained.sources:
        other = f"  ({source.path})" if source.path != explained.key else ""
        removed = explained.kind == "removed" and source is explained.sources[-1]
        yield f"    {source.where:<{width}}  {'removed' if removed else shown(source.value)}{other}"


def _mount(explained: Explanation, mount: Mount) -> Iterator[str]:
    if explained.option is not None:
        chosen = "selects" if explained.option in mount.selected else "does not select"
        yield f"  group       {mount.name} {chosen} it, as option '{explained.option}'"
    else:
        yield f"  group       {mount.name}, with {', '.join(mount.selected) or 'nothing'} selected"
    for choice in mount.choices:
        yield f"    {choice.where}  {shown(choice.value)}"
    others = [option for option in mount.options if option not in mount.selected]
    if others:
        yield "  options     " + _cut(others) + " can also be selected"
    if others or mount.several:
        yield "  write       " + "  or  ".join(_forms(mount, explained.option, others))


def _forms(mount: Mount, option: str | None, others: list[str]) -> list[str]:
    """Return overrides that add, replace, or remove a group's options, such as ``+reward@env.rewards=alive``."""
    other = option if option in others else (others[0] if others else "<option>")
    if not mount.several:
        return [f"{mount.name}={other}"]
    forms = [f"+{mount.name}={other}"]
    if option is not None and option in mount.selected:
        forms = [f"~{mount.package}.{option}"]
    remaining = [name for name in mount.selected if name != option]
    return [*forms, f"{mount.name}=[{','.join([*remaining[:2], '...'])}]"]


def _cut(values: list[str]) -> str:
    more = f" and {len(values) - _SHOWN} more" if len(values) > _SHOWN else ""
    return ", ".join(values[:_SHOWN]) + more


def document(explained: Explanation) -> dict[str, object]:
    """Return the explanation of a config key as a JSON document."""
    other, mount, group = explained.alternatives, explained.mount, dict[str, object]()
    if mount is not None:
        group = {"name": mount.name, "package": mount.package, "option": explained.option}
        group |= {"selected": list(mount.selected), "options": list(mount.options)}
        group |= {"choices": [vars(choice) for choice in mount.choices]}
    return {
        "key": explained.key,
        "kind": explained.kind,
        "read": explained.is_read,
        "value": explained.value,
        "raw": explained.raw,
        "unit": explained.unit,
        "meaning": [{"text": note.text, "where": note.where, "about": note.about} for note in explained.meanings],
        "sources": [source_document(source) for source in explained.sources],
        "references": [vars(reference) for reference in explained.references],
        "type": other.type or None,
        "limits": list(other.limits),
        "values": list(other.values),
        "default": other.default if other.has_default else None,
        "required": not other.has_default if other.type else None,
        "not_set": dict(other.keys),
        "group": group or None,
    }
