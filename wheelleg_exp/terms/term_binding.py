"""Import the function or class that a term's config names in ``_target_``, and bind config keys to its parameters.

``_target_`` can only name functions and classes in allowed packages, so that a config cannot call arbitrary code.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, cast

from wheelleg_exp import packages
from wheelleg_exp.constraints import Bounds, Natural, Node, NonNegativeInterval, NotEmpty, Ordered
from wheelleg_exp.errors import ConfigError, UnreadKey, nearest_name
from wheelleg_exp.packages import installed_packages, joined_packages
from wheelleg_exp.user_exceptions import importing, in_words

TARGET = "_target_"
# Configs can call the functions and classes in ``_OWN_PACKAGES``, such as terms and sensors.
_OWN_PACKAGES = ("wheelleg_exp.mdp", "wheelleg_exp.managers", "wheelleg_exp.sim")


class NotAllowed(ConfigError):
    """The error if a config names a function or class outside the packages that configs can call."""


def allowed_packages() -> tuple[str, ...]:
    """Return the packages whose functions configs can call: this package's terms, and packages that declare themselves.

    A package declares itself with an entry point in the group ``wheelleg_exp.packages``, whose value is its name.
    """
    return tuple(dict.fromkeys((*_OWN_PACKAGES, *_declared_packages(), *joined_packages())))


# Cache the packages that configs can call, because reading the metadata of all installed packages is slow.
_declared_packages = functools.cache(installed_packages)


def require_allowed(target: str, path: str) -> None:
    """Raise ConfigError unless ``target`` is in an allowed package, so that a config cannot call arbitrary code."""
    packages = allowed_packages()
    if not is_inside(target, packages):
        # Suggest the most similar package, such as ``my_robot.rewards`` for ``my_robt.rewards``.
        top, _, rest = target.partition(".")
        near = nearest_name(top, [package.split(".")[0] for package in packages])
        declared = 'or in a package that your project declares (recipe "A term of your own")'
        message, key = f"target '{target}' is outside the allowed packages", f"{path}.{TARGET}"
        nearest = f"{near}.{rest}" if near not in (None, top) else None
        raise NotAllowed(message, key=key, expected=f"a target in {', '.join(packages)}, {declared}", nearest=nearest)


def is_inside(name: str, packages: tuple[str, ...]) -> bool:
    """Return whether a dotted name is inside one of the given Python packages."""
    return any(name.startswith(f"{package}.") for package in packages)


_HYDRA_ONLY = ("_args_", "_partial_", "_recursive_", "_convert_")  # No term can contain Hydra keys such as ``_args_``.

# For each config section, ``RESERVED`` lists keys that the manager reads and does not pass to the term's function.
RESERVED: dict[str, tuple[str, ...]] = {
    "commands": (),
    "actions": ("delay", "delay_jitter"),
    "observations": (
        *("modifiers", "noise", "clip", "scale", "history_length", "flatten_history_dim", "delay", "delay_jitter"),
    ),
    "events": ("mode", "interval_range_s", "is_global_time", "min_step_count_between_reset"),
    "rewards": ("weight",),
    "terminations": ("time_out",),
    "curriculum": (),
    "recorders": (),
}

# If an observation function has the parameter ``SHARED``, it gets this key, and the manager does not scale its value.
SHARED = "scale"

# The config section ``recorders`` may be missing.
OPTIONAL = "recorders"

# ``FIELD_TYPES`` has the type of each config key that managers read, such as ``weight``.
FIELD_TYPES: dict[str, object] = {
    "weight": float,
    "time_out": bool,
    "mode": Annotated[str, NotEmpty()],
    "interval_range_s": NonNegativeInterval | None,
    "is_global_time": bool,
    "min_step_count_between_reset": Natural,
    "history_length": Natural,
    "flatten_history_dim": bool,
    "modifiers": Sequence[Node] | None,
    "noise": Node | None,
    "clip": Bounds | None,
    "scale": float | Annotated[Sequence[float], NotEmpty()] | None,
    "delay": Annotated[Sequence[Natural], Ordered()] | None,
    "delay_jitter": Natural,
}
REQUIRED_FIELDS: dict[str, tuple[str, ...]] = {"rewards": ("weight",), "events": ("mode",)}
# A user-defined event mode must not be similar to ``EVENT_MODES``: ``resett`` counts as a misspelling.
EVENT_MODES = ("prestartup", "startup", "reset", "interval", "step")
# For example, the field ``interval_range_s`` has an effect only in events with the mode ``interval``.
MODE_FIELDS = {"interval_range_s": "interval", "is_global_time": "interval", "min_step_count_between_reset": "reset"}

# Managers pass ``env``, ``env_ids``, and ``generator`` to terms, so the config of a term cannot set these arguments.
INJECTED = ("env", "env_ids", "generator")
_ISAAC_LAB = ("wheelleg_exp.isaaclab.", "wheelleg_exp.isaaclab_tasks.")
_CFG_ENV = ["cfg", "env"]  # Constructors of Isaac Lab's terms have the parameters ``cfg`` and ``env``.

# ``_MOVED`` maps old ``_target_`` paths, which configs of earlier versions can contain, to the current paths.
_MOVED = {"wheelleg_exp.sim.contact.ContactSensor": "wheelleg_exp.sim.sensors.ContactSensor"}


class NotSelected(ConfigError):
    """The error if a term in a config has settings but no ``_target_``."""


@dataclass(frozen=True)
class TermNode:
    """The config of a term: the manager reads ``fields``, and passes ``params`` to the function or class ``target``."""

    name: str
    path: str
    target: str
    fields: dict[str, object] = field(default_factory=dict)
    params: dict[str, object] = field(default_factory=dict)


def drop_removed(config: Mapping[str, object], raw: Mapping[str, object] | None = None) -> tuple[str, ...]:
    """Remove terms that are null, and return their config keys. Add missing config sections as empty mappings.

    ``raw`` is the config with its interpolations. With it, also remove each term whose joints or bodies are those of a
    role that the robot lacks, such as ``${env.robot.joint_sets.legs}`` of a robot without leg joints.
    """
    written = raw.get("env") if raw is not None else None
    env = config.get("env")
    if not isinstance(env, dict):
        return ()
    removed: list[str] = []
    for section in RESERVED:
        if section == OPTIONAL and section not in env:
            continue
        if env.get(section) is None:
            env[section] = {}
        removed += _drop_null(env, section, "env", None if section == "observations" else written)
    groups = env["observations"]
    if isinstance(groups, dict):
        for name, group in groups.items():
            if isinstance(group, dict) and "terms" in group:
                group["terms"] = {} if group["terms"] is None else group["terms"]
                removed += _drop_null(group, "terms", f"env.observations.{name}", _below(written, "observations", name))
    return tuple(removed)


def _drop_null(parent: dict[str, object], key: str, path: str, written: object) -> list[str]:
    section = parent[key]
    if not isinstance(section, dict):
        return []
    gone = {name for name, node in section.items() if node is None or _lacks_role(node, _below(written, key, name))}
    parent[key] = {name: node for name, node in section.items() if name not in gone}
    return [f"{path}.{key}.{name}" for name in section if name in gone]


def _below(node: object, *keys: object) -> object:
    for key in keys:
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def _lacks_role(node: object, raw: object) -> bool:
    """Return whether an interpolation in a term gives an empty list of joints or bodies."""
    if not isinstance(node, Mapping) or not isinstance(raw, Mapping):
        return False
    empty = (node.get(kind) == [] and isinstance(raw.get(kind), str) for kind in ("joint_names", "body_names"))
    return any(empty) or any(_lacks_role(part, raw.get(key)) for key, part in node.items())


def split_node(kind: str, path: str, node: object) -> TermNode:
    """Split a term's config into fields for the manager, such as ``weight``, and parameters for the function."""
    if not isinstance(node, Mapping):
        raise ConfigError(f"a term must be a mapping, not {node!r}", key=path, expected="_target_ and parameters")
    if TARGET not in node:
        short = (str(key) for key in node if len(str(key)) <= len(TARGET) + 1)
        misspelled = next((key for key in short if nearest_name(key, [TARGET])), None)
        if misspelled is not None:
            expected = "_target_: package.module.name"
            raise UnreadKey(key=f"{path}.{misspelled}", expected=expected, nearest=TARGET)
        message = "there are settings for this term, but the term is not selected (it has no _target_)"
        raise NotSelected(message, key=path, expected=f"the term in the task's list of {kind}, or no settings for it")
    reserved: Sequence[str] = RESERVED[kind]
    if SHARED in reserved and SHARED in node:
        with suppress(ConfigError):  # A wrong target is reported when the term is bound.
            if SHARED in signature_parameters(resolve_target(str(node[TARGET]), path)):
                reserved = [name for name in reserved if name != SHARED]
    fields = {k: v for k, v in node.items() if k in reserved}
    params = {k: v for k, v in node.items() if k not in reserved and k != TARGET}
    return TermNode(path.rsplit(".", 1)[-1], path, str(node[TARGET]), fields, params)


def walk_nodes(node: object, path: str = "") -> Iterator[tuple[str, Mapping[str, object]]]:
    """Yield ``(path, mapping)`` for each mapping in a config; a path is like ``a.b``, or ``a[0].b`` in a list."""
    if isinstance(node, Mapping):
        yield path, node
        for key, value in node.items():
            yield from walk_nodes(value, f"{path}.{key}" if path else str(key))
    elif isinstance(node, (list, tuple)):
        for index, value in enumerate(node):
            yield from walk_nodes(value, f"{path}[{index}]")


def target_arguments(node: Mapping[str, object], path: str) -> dict[str, object]:
    """Return the keyword arguments in a ``_target_`` node, which are all keys except ``_target_``."""
    for key in node:
        if key in _HYDRA_ONLY:
            expected = f"{TARGET} and its parameters alone"
            raise ConfigError(f"Hydra's key '{key}' is not supported in terms", key=f"{path}.{key}", expected=expected)
    return {str(key): value for key, value in node.items() if key != TARGET}


def resolve_target(target: str, path: str) -> Callable[..., object]:
    """Import and return the function or class with the dotted path ``target``, which must be in an allowed package."""
    target = _MOVED.get(target, target)
    require_allowed(target, path)
    module_name, _, attribute = target.rpartition(".")
    try:
        packages.make_importable(target)
    except ConfigError as error:
        error.key = error.key or f"{path}.{TARGET}"
        raise
    try:
        with importing(module_name):
            module = import_module(module_name)
    except Exception as error:  # A user's module can raise any exception when it is imported.
        reason = str(error) if isinstance(error, ImportError) else in_words(error)
        absent = isinstance(error, ModuleNotFoundError) and f"{module_name}.".startswith(f"{error.name}.")
        expected = "package.module.name" if absent else "a module that can be imported"
        message = f"cannot import '{module_name}': {reason}"
        raise ConfigError(message, key=f"{path}.{TARGET}", expected=expected) from error
    found: object = getattr(module, attribute, None)
    why = getattr(module, "ABSENT", {}).get(attribute)
    if why is not None:
        raise ConfigError(f"Isaac Lab's '{attribute}' is not supported: {why}", key=f"{path}.{TARGET}")
    if not callable(found):
        public = [n for n in dir(module) if not n.startswith("_") and callable(getattr(module, n))]
        nearest = target.replace(":", ".") if ":" in attribute else nearest_name(attribute, public)
        raise ConfigError(f"'{module_name}' has no callable '{attribute}'", key=f"{path}.{TARGET}", nearest=nearest)
    # Check where ``found`` is defined, because a module in an allowed package can import functions from elsewhere.
    require_allowed(f"{getattr(found, '__module__', None) or module_name}.{attribute}", path)
    return found


def resolve_class(name: object) -> Callable[..., object] | None:
    """Return what a ``class_name`` of an agent names, or None; raise ConfigError if its module cannot be imported."""
    from rsl_rl.utils import resolve_callable

    text = str(name).replace(":", ".")
    packages.make_importable(text)
    try:
        with importing(text):
            found: Callable[..., object] = resolve_callable(name)
        return found
    except Exception as error:
        absent = isinstance(error, ImportError) and (error.name is None or f"{text}.".startswith(f"{error.name}."))
        if absent or isinstance(error, AttributeError) or "." not in text:
            return None
        raise ConfigError(f"cannot import '{text}': {in_words(error)}", expected="a module that imports") from error


def takes_cfg(target: Callable[..., object]) -> bool:
    """Return whether ``target`` is a class with the constructor ``(cfg, env)``, as in Isaac Lab.

    A subclass of an Isaac Lab class may also have the constructor ``(env, cfg)``.
    """
    if not inspect.isclass(target):
        return False
    first = list(inspect.signature(target).parameters)[:2]
    return first == _CFG_ENV or (first == _CFG_ENV[::-1] and any(takes_cfg(kind) for kind in target.__mro__[1:-1]))


def read_from(target: Callable[..., object]) -> Callable[..., object]:
    """Return the function or class that defines which parameters a term's config can set.

    This is ``__call__`` of a class with the constructor ``(cfg, env)``, or else the class of its ``cfg``; the method
    ``from_config`` of a class that has it; otherwise the function or class itself.
    """
    if hasattr(target, "from_config"):
        return cast(Callable[..., object], target.from_config)
    if not takes_cfg(target):
        return target
    if inspect.isclass(target) and any("__call__" in vars(kind) for kind in target.__mro__[:-1]):
        called: Callable[..., object] = vars(next(k for k in target.__mro__ if "__call__" in vars(k)))["__call__"]
        return called
    return cfg_class(target) or target


def cfg_class(target: Callable[..., object]) -> type | None:
    """Return the class in the type annotation of the constructor's parameter ``cfg``; None if there is no class."""
    made = vars(target).get("__init__") or target.__init__
    found = made.__annotations__.get("cfg")
    if isinstance(found, str):
        first, *rest = found.split(".")
        found = getattr(made, "__globals__", {}).get(first)
        for name in rest:
            found = getattr(found, name, None)
    return found if inspect.isclass(found) else None


def written_for_isaac_lab(target: Callable[..., object]) -> bool:
    """Return whether a term's module imports ``wheelleg_exp.isaaclab``: such a term draws from global generators."""
    module = sys.modules.get(getattr(target, "__module__", ""))
    found = vars(module).values() if module is not None else ()
    names = [str(getattr(v, "__name__" if inspect.ismodule(v) else "__module__", "")) for v in found]
    names += [str(getattr(v, "__globals__", {}).get("__name__", "")) for v in found]  # wrapped stock events
    return any(f"{name}.".startswith(_ISAAC_LAB) for name in names)


def signature_parameters(target: Callable[..., object]) -> dict[str, inspect.Parameter]:
    """Return the parameters of ``target`` that a config can set; the program passes positional-only parameters."""
    parameters = inspect.signature(read_from(target)).parameters.values()
    settable = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return {p.name: p for p in parameters if p.name not in ("self", *INJECTED) and p.kind in settable}
