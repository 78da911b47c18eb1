"""Read the documentation of keys: docstrings, comments in YAML, and a table of the keys that have no docstring."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from wheelleg_exp.config.tree_lookup import yaml_node

# ``FIELDS`` maps each term field that managers read to its description and default (``...`` if it is required).
FIELDS: dict[str, tuple[str, object]] = {
    "weight": ("factor on the term; a step adds weight times value times the control step to the return", ...),
    "time_out": ("whether the episode is only cut off: it ends, but has not failed", False),
    "mode": ("when it runs: prestartup and startup once, reset at each reset, interval after random waits", ...),
    "interval_range_s": ("shortest and longest wait between two runs of mode interval, s", None),
    "is_global_time": ("whether all environments share one timer", False),
    "min_step_count_between_reset": ("fewest control steps between two runs of mode reset", 0),
    "modifiers": ("functions of the observation, in order, before noise", None),
    "noise": ("noise on the observation, if the group has enable_corruption", None),
    "clip": ("bounds of the observation before scaling", None),
    "scale": ("factor on the observation, or one for each component", None),
    "history_length": ("control steps stored, 0: only the present; the group's own setting overrides it", 0),
    "delay": ("shortest and longest delay, physics steps, drawn at each reset; null: no delay", None),
    "delay_jitter": ("largest random addition to the delay, physics steps, drawn at each physics step", 0),
    "flatten_history_dim": ("whether the history is one vector, oldest first", True),
}

# ``KEYS`` describes config keys that no docstring describes; ``*`` matches one part of a dotted key.
KEYS: dict[str, str] = {
    "seed": "seed of every random stream of the run",
    "init_from": "run (path, id, `latest`) or checkpoint with the initial networks; null: new networks",
    "init_from_what": "what is loaded: networks (policy and critic), policy, or learning (also the optimiser)",
    "task": "what is trained",
    "task.name": "name of the task; its run directories are in <run.root>/<name>",
    "check": "known and accepted findings of the check",
    "check.silence": "the reason for each silenced rule of `wheelleg check --physics`, by the rule's name",
    "env": "the environments: number, episode length, decimation, scene and terms",
    "env.num_envs": "environments simulated in parallel",
    "env.episode_length_s": "longest episode, s",
    "env.decimation": "physics steps of one control step",
    "env.sim": "the solver",
    "env.scene": "ground and sensors",
    "env.robot": "the robot: its file, its initial state and its actuators",
    "env.commands": "the commands that the robot follows, by term",
    "env.actions": "what the policy's output means; the order of terms is the layout of the action vector",
    "env.observations": "the inputs of the networks, by group",
    "env.observations.*": "one observation: its terms, joined in their order",
    "env.observations.*.terms": "the terms; their order is the layout of the observation",
    "env.observations.*.concatenate_terms": "whether the terms are joined to one vector",
    "env.observations.*.enable_corruption": "whether the noise of the terms is applied",
    "env.observations.*.history_length": "control steps stored of each term; overrides the terms' own setting",
    "env.observations.*.flatten_history_dim": "whether histories are flattened, oldest first",
    "env.observations.*.concatenate_dim": "dimension along which terms are joined: -1 the last, 0 the first",
    "env.observations.*.history_order": "order in flattened histories: term by term, or time step by time step",
    "env.events": "changes to the simulation at start, at resets and in between; terms run in their order",
    "env.rewards": "the rewards: each step adds weight times value times the control step of each term",
    "env.terminations": "the conditions that end an episode",
    "env.curriculum": "changes in the course of the training; terms run in their order",
    "env.recorders": "the data of each episode in the run's dataset; recorders do not change the training",
    "env.is_finite_horizon": "whether a time-out ends the return: no value of the last state is added",
    "env.realism": "what a real robot adds to the task: errors of sensors, delays, and events",
    "env.dataset": "which of the recorders' episodes are written",
    "pipeline": "tasks one after the other, with gates between them",
    "protocol": "fixed scenarios of `wheelleg evaluate`, and their metrics",
    "agent": "the learning algorithm and its networks, in rsl_rl's own terms",
    "agent.algorithm": "the algorithm: a class of rsl_rl and its parameters",
    "agent.actor": "the policy's network: a class of rsl_rl and its parameters",
    "agent.critic": "the value network: a class of rsl_rl and its parameters",
    "agent.student": "the network that learns from the teacher: a class of rsl_rl and its parameters",
    "agent.teacher": "the trained network that the student imitates: a class of rsl_rl and its parameters",
    "agent.*.class_name": "class, of rsl_rl or of an allowed package (module:Class)",
    "agent.*.distribution_cfg.class_name": "class of the distribution of actions",
    "agent.obs_groups": "the observation groups of each network, in order",
    "agent.obs_groups.*": "the observation groups of this network, in order",
    "agent.num_steps_per_env": "control steps of one rollout in each environment",
    "agent.max_iterations": "iterations in total",
    "agent.save_interval": "iterations between checkpoints",
    "agent.logger": "tensorboard; wandb also sends scalars and config to Weights & Biases; null: no event files",
    "agent.device": "device of the networks",
    "agent.torch_threads": "threads of torch; recorded in the run",
    "agent.matmul": "number format of the update's products: float32, bfloat16 or tf32; auto: by the hardware",
    "agent.graph_update": "on a GPU, whether PPO's acting and update are CUDA graphs",
    "agent.warm_start": "rollouts before the first iteration, in which the policy imitates the reference controller",
    "agent.warm_critic": "first iterations, in which only the critic learns",
    "agent.initial_kl": "loss that keeps the policy near the policy of init_from; null: none",
    "agent.average_iterations": "iterations over which the played policy's weights are averaged; 0: no average",
    "agent.clip_actions": "bound of the raw actions; null: unbounded",
    "agent.max_non_finite": "most episodes that a number that is not finite can end in one iteration, per environment",
    "agent.symmetry": "how the robot is mirrored left to right; null: the robot is not symmetric",
    "agent.torch_compile_mode": "mode of torch.compile; null: torch.compile is not used",
    "recording": "what is recorded",
    "run": "root and name of the run directory",
    "play": "how figures are measured",
    "drive": "how a robot is driven by hand, or by a script",
    "*._target_": "the function or class that is called",
}


def meaning_of(keys: tuple[str, ...]) -> str:
    """Return the description of a config key in the table ``KEYS``; empty if ``KEYS`` does not contain the key."""
    path = ".".join(keys)
    for pattern, text in KEYS.items():
        if pattern == path or (len(pattern.split(".")) == len(keys) and fnmatchcase(path, pattern)):
            return text
    return KEYS["*._target_"] if keys and keys[-1] == "_target_" else ""


_PACKAGE = re.compile(r"\s*#+\s*@package\b")


def comment_at(file: Path, line: int) -> str:
    """Return the comment on a line of a YAML file, or the equally indented comment directly above this line.

    A comment at the top of a YAML file belongs to the first key only if the file has no other top-level keys.
    """
    lines = _lines(file, file.stat().st_mtime_ns)
    if not 1 <= line <= len(lines):
        return ""
    if own := _split(lines[line - 1])[1]:
        return own
    indent, top, found = _indent(lines[line - 1]), line - 1, list[str]()
    while top > 0 and _is_comment(lines[top - 1]) and _indent(lines[top - 1]) == indent:
        top -= 1
        found.insert(0, _split(lines[top])[1])
    root = yaml_node(file)
    if found and top == 0 and not (root is not None and len(root.value) == 1):
        return ""
    return " ".join(text for text in found if text and not text.startswith("@"))


def file_comment(file: Path) -> str:
    """Return the comment directly below a file's ``# @package`` line, or an empty text without such a comment."""
    lines = _lines(file, file.stat().st_mtime_ns)
    if not lines or not _PACKAGE.match(lines[0]):
        return ""
    found = []
    for line in lines[1:]:
        if not _is_comment(line):
            break
        found.append(_split(line)[1])
    return " ".join(text for text in found if text)


@lru_cache(maxsize=256)
def _lines(file: Path, _stamp: int) -> list[str]:
    return file.read_text(encoding="utf-8").splitlines()


def _split(text: str) -> tuple[str, str]:
    quote = ""
    for index, letter in enumerate(text):
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "'\"":
            quote = letter
        elif letter == "#" and (index == 0 or text[index - 1].isspace()):
            return text[:index], text[index + 1 :].strip()
    return text, ""


def _is_comment(text: str) -> bool:
    return text.lstrip().startswith("#")


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip())


_SECTION = re.compile(r"^(Args|Arguments|Attributes|Parameters):$")
_ENTRY = re.compile(r"^(\s*)(\*{0,2}\w+)(?: \([^)]*\))?:\s*(.*)$")

_ATOM = r"(?:rad|deg|kg|mm|m|ms|s|N|Hz|MB|GiB)"
_POWER = r"(?:[²³]|\^-?\d)?"
_PRODUCT = rf"(?:1(?=/)|{_ATOM}{_POWER}|\({_ATOM}(?:[·*/]{_ATOM})*\){_POWER})(?:[·*/]{_ATOM}{_POWER})*"
_WORDS = r"control steps?|physics steps?|iterations?|seconds|radians|megabytes"
_UNIT = rf"(?:per )?(?:{_PRODUCT}|{_WORDS})(?: per (?:{_PRODUCT}|unit of action))?"
_LIST = rf"{_UNIT}(?:, {_UNIT})*"
# The next word shows whether a first letter is a unit: N means newton in "N of thrust", but not in "N environments".
_AFTER = r"of|on|between|from|above|below|beyond|at|in|to|each|that|before|after|a|per|by|in"
_FIRST = re.compile(rf"^({_LIST})(?=$|[;,.:]| (?:{_AFTER})\b)")
_LATER = re.compile(rf"(?:, |\(|: )({_UNIT})(?=$|[;,.:)])")


def unit_in(text: str) -> str | None:
    """Return the physical unit at the start of a comment or docstring line, or after a comma; None without a unit."""
    matches = (pattern.search(text) for pattern in (_FIRST, _LATER))
    return next((match.group(1) for match in matches if match), None)


def summary(target: object) -> str:
    """Return the first paragraph of the docstring of an object, on one line."""
    text = inspect.getdoc(target) or ""
    return " ".join(text.strip().split("\n\n")[0].split())


def headline(target: object) -> str:
    """Return the first line of the docstring of an object."""
    text = (inspect.getdoc(target) or "").strip()
    return text.splitlines()[0] if text else ""


def parameter_lines(target: Callable[..., object]) -> dict[str, str]:
    """Return the description of each parameter in the docstrings of a function, or of a class and its base classes."""
    if not inspect.isclass(target):
        return parameters_in(inspect.getdoc(target) or "")
    found: dict[str, str] = {}
    for kind in reversed(target.__mro__[:-1]):
        for text in (kind.__dict__.get("__doc__"), getattr(kind.__dict__.get("__init__"), "__doc__", None)):
            found |= parameters_in(inspect.cleandoc(text or ""))
    return found


def parameters_in(text: str) -> dict[str, str]:
    """Return the description of each parameter in a Google-style docstring."""
    found: dict[str, str] = {}
    name, inside, indent = "", False, -1
    for line in text.splitlines():
        if not line.startswith(" "):
            inside, name, indent = bool(_SECTION.match(line)) or (inside and not line.strip()), "", -1
            continue
        entry = _ENTRY.match(line)
        depth = len(line) - len(line.lstrip())
        if inside and entry and (indent < 0 or depth == indent):
            name, indent = entry.group(2).lstrip("*"), depth
            found[name] = entry.group(3)
        elif inside and name:
            found[name] = f"{found[name]} {line.strip()}".strip()
    return found


def is_own(module: ModuleType, found: object) -> bool:
    """Return whether an object is defined, not only imported, in a module or the module's submodules."""
    return f"{getattr(found, '__module__', None)}.".startswith(f"{module.__name__}.")
