"""Find the type, default, bounds, and description of each key that the config accepts.

The type comes from the code that reads the key: a section's dataclass, a term's signature, or a class of rsl_rl.
"""

from __future__ import annotations

import dataclasses
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.explaining.key_documentation import FIELDS, KEYS, meaning_of, parameter_lines
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.rl.options import PARAMETERS
from wheelleg_exp.terms import term_binding
from wheelleg_exp.terms.config_sections import dataclass_of, keys_of
from wheelleg_exp.terms.config_values import options_in
from wheelleg_exp.terms.key_syntax import Keys, dotted
from wheelleg_exp.terms.term_binding import FIELD_TYPES, RESERVED, TARGET, resolve_target, signature_parameters
from wheelleg_exp.terms.term_errors import type_hints

REQUIRED = inspect.Parameter.empty
_RSL_CLASS = "class_name"
# A config cannot set the following constructor parameters, because rsl_rl itself passes their values.
_PASSED_TO_ALGORITHM = ("self", "actor", "critic", "student", "teacher", "storage", "device", "multi_gpu_cfg")
_PASSED_TO_NETWORK = ("self", "obs", "obs_groups", "obs_set", "output_dim", "cnns")
_PASSED_TO_EXTENSION = ("self", "num_states", "obs_groups", "device", "env")
# Classes of rsl_rl.extensions read the config sections ``rnd_cfg`` and ``symmetry_cfg`` of ``agent.algorithm``.
EXTENSIONS = {"rnd_cfg": "RandomNetworkDistillation", "symmetry_cfg": "Symmetry"}
# rsl_rl reads the following config keys, although no constructor of rsl_rl has parameters with these names.
_OTHER_KEYS: dict[str, dict[str, object]] = {"algorithm": {"share_cnn_encoders": bool}}

# In manager terms of all config sections, the parameter `command_name` is the name of a term in `env.commands`.
_NAMES = {
    ("", "command_name"): "commands",
    ("", "action_name"): "actions",
    ("commands", "velocity_command"): "commands",
    ("curriculum", "term_name"): "rewards",
    ("events", "curriculum_name"): "curriculum",
    ("curriculum", "reward_term_name"): "rewards",
}


@dataclass(frozen=True)
class Slot:
    """The type, default, and description of one key that a config can set.

    ``default`` is ``REQUIRED`` without a default. ``reader`` is the dotted name of the code that reads the key.
    """

    annotation: Any = Any
    # `inspect.signature` would treat a plain default ``Parameter.empty`` as no default, so use a factory.
    default: Any = field(default_factory=lambda: REQUIRED)
    meaning: str = ""
    reader: str = ""


def slot(tree: Mapping[str, object], keys: Keys) -> Slot | None:
    """Return the type, default, and description of a config key; None if no code reads the key."""
    if not keys:
        root = schema.root_of(tree)
        return Slot(root, reader=_name(root))
    named = slots(tree, keys[:-1])
    if named:
        node = section_at(tree, keys[:-1])
        return named.get(keys[-1]) or (Slot() if TARGET in node and target_of(node) is None else None)
    above = slot(tree, keys[:-1])
    element = None if above is None else _element(above, keys[-1])
    if element is None:
        return None
    # A term such as ``env.rewards.alive`` must not inherit the description of ``env.rewards``.
    inherited = "" if section_of(keys) is not None else element.meaning
    return dataclasses.replace(element, meaning=meaning_of(keys) or inherited)


def slots(tree: Mapping[str, object], keys: Keys) -> dict[str, Slot]:
    """Return the types and defaults of the subkeys of a section such as ``env.sim``; empty if any subkey is valid."""
    node = at(tree, keys)
    section = section_of(keys)
    if section is not None and isinstance(node, Mapping) and TARGET in node:
        made = {}
        for name in RESERVED[section]:
            meaning, default = FIELDS.get(name, ("", ...))
            annotation = FIELD_TYPES.get(name, Any)
            made[name] = Slot(annotation, REQUIRED if default is ... else default, meaning, f"the manager of {section}")
        return {**_target_slots(node), **made}
    if isinstance(node, Mapping) and TARGET in node:
        return _target_slots(node)
    if isinstance(node, Mapping) and keys[:1] == ("agent",) and _RSL_CLASS in node:
        own = {_RSL_CLASS: Slot(str, meaning=KEYS["agent.*.class_name"])}
        found = rsl_class(node[_RSL_CLASS])
        return own if found is None else own | class_slots(found, keys[-1])
    extension = extension_of(keys)
    if extension is not None and isinstance(node, Mapping):
        return class_slots(extension, keys[-1])
    above = slot(tree, keys)
    if above is None:
        return {}
    default, kind = above.default, type(above.default)
    if node is None and default is not REQUIRED and kind.__module__ != "builtins":
        # The subkeys of a parameter with a default object, such as ``SceneEntityCfg()``, are the object's attributes.
        attributes = _signature_slots(kind, signature_parameters(kind))
        if attributes:
            return {n: dataclasses.replace(s, default=getattr(default, n, s.default)) for n, s in attributes.items()}
    options = dataclass_of(above.annotation, section_at(tree, keys))
    if options is None:
        return {}
    lines, fields = parameter_lines(options), {f.name: f for f in dataclasses.fields(options)}
    made = {}
    for name, key in keys_of(options).items():
        factory, default = fields[name].default_factory, fields[name].default
        default = factory() if factory is not dataclasses.MISSING else default
        default = REQUIRED if default is dataclasses.MISSING else default
        made[name] = Slot(key.annotation, default, lines.get(name) or meaning_of((*keys, name)), _name(options))
    return made


def is_settable(tree: Mapping[str, object], keys: Keys) -> bool:
    """Return whether code reads a key by its name, such as a parameter; False for the name of a term."""
    of_rules = keys[:-1] in (("check", "silence"), ("env", "robot", "silence"))
    names = schema.PHYSICS_RULES if of_rules else slots(tree, keys[:-1])
    return dotted(keys) in KEYS or keys[-1] in names


def section_of(keys: Keys) -> str | None:
    """Return the section of a term's config key, such as ``rewards`` for ``env.rewards.alive``; None for other keys."""
    if len(keys) == 3 and keys[0] == "env" and keys[1] in RESERVED and keys[1] != "observations":
        return keys[1]
    observation = len(keys) == 5 and keys[:2] == ("env", "observations") and keys[3] == "terms"
    return "observations" if observation else None


def named_section(section: str | None, name: str) -> str | None:
    """Return the config section of the term that a parameter names, such as ``commands`` for ``command_name``."""
    return _NAMES.get((section or "", name)) or _NAMES.get(("", name))


def target_of(node: object) -> Callable[..., object] | None:
    """Import the function or class in the ``_target_`` of a config node; return None without a valid ``_target_``."""
    name = node.get(TARGET) if isinstance(node, Mapping) else None
    try:
        return resolve_target(str(name), "") if name is not None else None
    except ConfigError:
        return None


def _target_slots(node: Mapping[str, object]) -> dict[str, Slot]:
    own = {TARGET: Slot(str, meaning=KEYS["*._target_"])}
    target = target_of(node)
    return own if target is None else {**own, **_signature_slots(target, signature_parameters(target))}


def _signature_slots(target: Callable[..., object], parameters: Mapping[str, inspect.Parameter]) -> dict[str, Slot]:
    hints, lines = type_hints(target), parameter_lines(target)
    return {n: Slot(hints.get(n, Any), p.default, lines.get(n, ""), _name(target)) for n, p in parameters.items()}


def class_slots(found: Callable[..., object], section: str) -> dict[str, Slot]:
    """Return the parameters of an rsl_rl class that a config can set in a section of ``agent``."""
    passed: tuple[str, ...] = _PASSED_TO_ALGORITHM if section == "algorithm" else _PASSED_TO_NETWORK
    passed = _PASSED_TO_EXTENSION if section in EXTENSIONS else passed
    open_ended = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = inspect.signature(found.__init__).parameters
    taken = {n: p for n, p in parameters.items() if n not in passed and p.kind not in open_ended}
    slots = _signature_slots(found, taken)
    known = {n: dataclasses.replace(s, annotation=PARAMETERS.get(n, s.annotation)) for n, s in slots.items()}
    return known | {name: Slot(annotation) for name, annotation in _OTHER_KEYS.get(section, {}).items()}


def extension_of(keys: Keys) -> type | None:
    """Return the rsl_rl class that reads ``agent.algorithm.rnd_cfg`` or ``symmetry_cfg``; None for any other key."""
    if len(keys) != 3 or keys[:2] != ("agent", "algorithm") or keys[2] not in EXTENSIONS:
        return None
    from rsl_rl import extensions

    found: type = getattr(extensions, EXTENSIONS[keys[2]])
    return found


def class_packages() -> tuple[str, ...]:
    """Return the packages that contain the classes allowed in the config section ``agent``."""
    return ("rsl_rl", "wheelleg_exp.rl", *term_binding.allowed_packages())


def rsl_class(name: object) -> Callable[..., object] | None:
    """Return the class that a ``class_name`` in the config names; None if no allowed package contains the class."""
    text = str(name).replace(":", ".")
    if "." in text and not term_binding.is_inside(text, class_packages()):
        return None
    try:
        found: Callable[..., object] | None = term_binding.resolve_class(name)
    except ConfigError:
        return None
    return found


def _element(above: Slot, key: str) -> Slot | None:
    """Return the element type of a config key's list or mapping; None if the key has a different type."""
    element = dataclasses.replace(above, default=REQUIRED)
    for annotation in options_in(above.annotation):
        origin, arguments = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
        if inspect.isclass(origin) and issubclass(origin, Mapping):
            return dataclasses.replace(element, annotation=arguments[1] if len(arguments) == 2 else Any)
        if key.isdigit() and origin in (list, tuple, Sequence) and arguments:
            return dataclasses.replace(element, annotation=arguments[0])
    return dataclasses.replace(element, annotation=Any) if above.annotation is Any and above.reader else None


def _name(thing: Callable[..., object]) -> str:
    return f"{thing.__module__}.{thing.__qualname__}"
