"""Copy the functions and classes that a run needs out of the author's Python files, without importing these files."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from importlib import import_module
from itertools import takewhile
from pathlib import Path

from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.files import read_text

_MOST_FILES = 20_000
_PACKAGES = ("isaaclab", "isaaclab_tasks")
_LIBRARIES = ("torch", "numpy", "math", "typing", "collections", "dataclasses", "scipy")
# Attributes of contact sensors in Isaac Lab 3.0, and their names in 2.3.2.
_FORCES = ("net_{}forces_w", "net_{}forces_w_history", "{}force_matrix_w", "{}force_matrix_w_history")
_ATTRIBUTES_OF_3 = {name.format("normal_"): name.format("") for name in _FORCES}
_ATTRIBUTES_OF_3["friction_force_matrix_w"] = "friction_forces_w"
# Attributes of ``actuators.target_command``, whose names ``joint_pos_target`` and so on are those of 2.3.2.
_COMMANDS_OF_3 = {"position": "pos", "velocity": "vel", "effort": "effort"}
_SETTER_OF_3 = re.compile(r"(.*)\.actuators\.target_command\.set_(position|velocity|effort)_index")
_OLD = {"omni.isaac.lab_tasks": "isaaclab_tasks", "omni.isaac.lab": "isaaclab"}


class AuthorTerms:
    """The Python files below a folder, for Isaac Lab 3.0 if ``version_3``, and the texts of modules made of them."""

    def __init__(self, folder: Path | None, package: str, version_3: bool = False) -> None:
        self._package, self._version_3 = package, version_3
        self._files: list[Path] = []
        if folder is not None:
            if not folder.is_dir():
                raise ConfigError("the path is no folder", key=f"--terms {folder}", expected="a folder of Python files")
            self._files = sorted(folder.rglob("*.py"))[:_MOST_FILES]
        self._trees: dict[Path, ast.Module] = {}
        self._needed: dict[Path, list[str]] = {}
        self._names: dict[Path, str] = {}

    def target(self, path: str, parameters: Iterable[str] = ()) -> str | None:
        """Return the target of ``module:name``, preferably with all ``parameters``; None if no file defines it."""
        module, _, name = path.replace(":", ".").rpartition(".")
        parts = module.split(".")
        defining = [file for file in self._files if name in self._definitions(file)]
        if not defining:
            return None

        def fit(file: Path) -> tuple[int, bool]:
            names = {part.arg for part in ast.walk(self._definitions(file)[name]) if isinstance(part, ast.arg)}
            pairs = zip(reversed(file.with_suffix("").parts), reversed(parts), strict=False)
            shared = takewhile(lambda pair: pair[0] == pair[1], pairs)  # the last parts of the path and of the module
            return len(list(shared)), names.issuperset(parameters)

        file = max(defining, key=fit)
        self._need(file, name)
        return f"{self._package}.{self._name(file)}.{name}"

    def modules(self) -> dict[str, str]:
        """Return the text of each new module by its name."""
        done: dict[str, str] = {}
        while True:  # The text of a module can show that another module needs more definitions.
            before = {file: list(names) for file, names in self._needed.items()}
            done = {self._name(file): self._text(file) for file in before}
            if self._needed == before:
                return done

    def _name(self, file: Path) -> str:
        """Return the name of the new module for a file; files of one name get names with their folders."""
        if file not in self._names:
            parts = [re.sub(r"\W", "_", part).lower() for part in file.with_suffix("").parts if part != "__init__"]
            options = ("_".join(parts[-count:]) for count in range(1, len(parts) + 1))
            self._names[file] = next(name for name in options if name not in (*self._names.values(), "__init__"))
        return self._names[file]

    def _definitions(self, file: Path) -> dict[str, ast.stmt]:
        if file not in self._trees:
            try:
                tree = ast.parse(read_text(file))
                self._trees[file] = _adapted(_OfVersion3().visit(tree) if self._version_3 else tree)
            except (SyntaxError, ValueError, RecursionError, WheellegError):
                self._trees[file] = ast.Module([], [])
        return {name: part for part in self._trees[file].body for name in _defined(part)}

    def _need(self, file: Path, name: str) -> None:
        """Note that a new module needs the definition ``name`` of ``file``, and what this definition uses."""
        found, needed = self._definitions(file), self._needed.setdefault(file, [])
        waiting = [name]
        while waiting:
            name = waiting.pop()
            if name in needed or name not in found:
                continue
            needed.append(name)
            waiting += _names(found[name], annotations=False) | _configs(found[name])

    def _text(self, file: Path) -> str:
        parts = self._parts(file)
        used, called = (set().union(*(_names(part, annotations=flag) for part in parts)) for flag in (True, False))
        called |= set().union(*map(_configs, parts))
        found = [part for part in ast.walk(self._trees[file]) if isinstance(part, (ast.Import, ast.ImportFrom))]
        imports = [text for item in found if (text := self._import(item, used, called, file))]
        source = "\n\n\n".join(ast.unparse(part) for part in parts)
        title = f'"""Terms copied from ``{file.name}`` by ``wheelleg import``."""'
        return "\n".join([title, "", "from __future__ import annotations", "", *imports, "", "", source, ""])

    def _parts(self, file: Path) -> list[ast.stmt]:
        return [part for part in self._trees[file].body if set(self._needed[file]) & set(_defined(part))]

    def _other(self, file: Path, name: str) -> Path | None:
        return next((other for other in self._files if other != file and name in self._definitions(other)), None)

    def _namespace(self, alias: str, file: Path) -> list[str]:
        """Return lines that replace an imported package of the author by a namespace of the used definitions."""
        parts = [part for item in self._parts(file) for part in ast.walk(item) if isinstance(part, ast.Attribute)]
        used = sorted({part.attr for part in parts if isinstance(part.value, ast.Name) and part.value.id == alias})
        lines, fields = ["from types import SimpleNamespace"], []
        for name in used:
            own = self._other(file, name)
            if own is not None:
                self._need(own, name)
            elif not _has("wheelleg_exp.isaaclab.envs.mdp", name):
                continue
            module = "wheelleg_exp.isaaclab.envs.mdp" if own is None else f"{self._package}.{self._name(own)}"
            lines.append(f"from {module} import {name} as {alias}_{name}")
            fields.append(f"{name}={alias}_{name}")
        return [*lines, f"{alias} = SimpleNamespace({', '.join(fields)})"] if used else []

    def _import(self, part: ast.Import | ast.ImportFrom, used: set[str], called: set[str], file: Path) -> str:
        """Return import lines of the names that are ``used``; names outside ``called`` are only in annotations."""
        if part.names[0].name == "*":
            module = getattr(part, "module", None) or ""
            return f"from {module} import *" if not getattr(part, "level", 0) and _exists(module) else ""
        names = [item for item in part.names if (item.asname or item.name.split(".")[0]) in used]
        if not names or (isinstance(part, ast.ImportFrom) and part.module == "__future__"):
            return ""
        if isinstance(part, ast.Import):
            lines = []
            for item in names:
                replaced: list[str] = []
                if item.asname is not None and not _exists(item.name):
                    replaced = self._namespace(item.asname, file)
                lines += replaced or [ast.unparse(ast.Import([item]))]
            return "\n".join(lines)
        module, lines = part.module or "", []
        for item in names:
            own = self._other(file, item.name)
            alias = f" as {item.asname}" if item.asname else ""
            called_here = (item.asname or item.name) in called
            if own is not None and called_here and (part.level or not _has(module, item.name)):
                self._need(own, item.name)
                lines.append(f"from {self._package}.{self._name(own)} import {item.name}{alias}")
            elif not part.level and _has(module, item.name):
                lines.append(f"from {module} import {item.name}{alias}")
            elif called_here:
                lines += self._namespace(item.asname or item.name, file) or [f"from {module} import {item.name}{alias}"]
        return "\n".join(lines)


def _defined(part: ast.stmt) -> list[str]:
    if isinstance(part, (ast.FunctionDef, ast.ClassDef)):
        return [part.name]
    targets: list[ast.expr] = []
    if isinstance(part, ast.Assign):
        targets = part.targets
    elif isinstance(part, ast.AnnAssign):
        targets = [part.target]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def _adapted(tree: ast.Module) -> ast.Module:
    """Move imports of Isaac Lab to this package, and replace annotations that are texts by what they say."""
    for part in ast.walk(tree):
        if isinstance(part, (ast.arg, ast.AnnAssign)) and isinstance(part.annotation, ast.Constant):
            part.annotation = ast.parse(str(part.annotation.value), mode="eval").body
        elif isinstance(part, ast.ImportFrom) and not part.level:
            part.module = _moved(part.module or "")
        elif isinstance(part, ast.Import):
            for item in part.names:
                item.name = _moved(item.name)
    return tree


class _OfVersion3(ast.NodeTransformer):
    """Replace what only Isaac Lab 3.0 has by what 2.3.2 has: ``x.torch`` and ``wp.to_torch(x)`` become ``x``."""

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self.generic_visit(node)
        node.attr = _ATTRIBUTES_OF_3.get(node.attr, re.sub(r"(_to_sim|_target)_index$", r"\1", node.attr))
        owner = ast.unparse(node.value).removesuffix(".actuators.target_command")
        if owner != ast.unparse(node.value) and node.attr in _COMMANDS_OF_3:
            return ast.parse(f"{owner}.data.joint_{_COMMANDS_OF_3[node.attr]}_target", mode="eval").body
        if node.attr in ("default_root_pose", "default_root_vel") and owner.split(".")[-1] == "data":
            part = ":7" if node.attr == "default_root_pose" else "7:"
            return ast.parse(f"{ast.unparse(node.value)}.default_root_state[:, {part}]", mode="eval").body
        if isinstance(node.value, ast.Attribute) and node.value.attr == "actuators" and node.attr.endswith("_effort"):
            node.value.attr, node.attr = "data", node.attr.replace("_effort", "_torque")
        return node.value if node.attr == "torch" else node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if setter := _SETTER_OF_3.fullmatch(ast.unparse(node.func)):
            node.func = ast.parse(f"{setter[1]}.set_joint_{setter[2]}_target", mode="eval").body
            for word in node.keywords:
                word.arg = "target" if word.arg == "value" else word.arg
        is_conversion = ast.unparse(node.func) in ("wp.to_torch", "warp.to_torch") and len(node.args) == 1
        return node.args[0] if is_conversion else node


def _configs(part: ast.AST) -> set[str]:
    """Return the names in the annotations of ``cfg``, whose class a class term needs."""
    found = [item.annotation for item in ast.walk(part) if isinstance(item, ast.arg) and item.arg == "cfg"]
    return {name for item in found if item is not None for name in _names(item, annotations=True)}


def _names(part: ast.AST, *, annotations: bool) -> set[str]:
    """Return the names that a definition uses, with or without those of its annotations."""
    found, waiting = set[str](), [part]
    while waiting:
        item = waiting.pop()
        skipped = [] if annotations else [getattr(item, "annotation", None), getattr(item, "returns", None)]
        found |= {item.id} if isinstance(item, ast.Name) else set()
        waiting += [child for child in ast.iter_child_nodes(item) if child not in skipped]
    return found


def _moved(module: str) -> str:
    for old, new in _OLD.items():
        module = new + module.removeprefix(old) if f"{module}.".startswith(f"{old}.") else module
    return f"wheelleg_exp.{module}" if module.split(".")[0] in _PACKAGES else module


def _has(module: str, name: str) -> bool:
    """Return whether a module of this package or of a library has a name; the author's own modules have not."""
    return _exists(module) and (not module.startswith("wheelleg_exp.") or hasattr(import_module(module), name))


def _exists(module: str) -> bool:
    if module.split(".")[0] != "wheelleg_exp":
        return module.split(".")[0] in _LIBRARIES
    try:
        import_module(module)
    except ImportError:
        return False
    return True
