"""Test that packages import only lower layers, and that no modules import each other in a cycle."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "wheelleg_exp"
NAME = PACKAGE.name
# The layers are listed from the lowest; packages of one line may import one another.
BASE = ("child_process", "errors", "paths", "files", "plain_data", "constraints", "machine")
LAYERS = (
    (*BASE, "torchrun", "progress", "stop_request"),
    ("user_exceptions",),
    ("packages", "definitions"),
    ("terms",),
    ("asset", "state", "rendering"),
    ("sim",),
    ("anatomy",),
    ("managers",),
    ("mdp", "env"),
    ("isaaclab",),
    ("isaaclab_tasks",),
    ("build", "rl"),
    ("config",),
    ("lint", "gym"),
    ("project",),
    ("evaluation",),
    ("run",),
    ("recording",),
    ("verify",),
    ("jobs",),
    ("robot_logs", "isaaclab_import"),
    ("inspection",),
    ("report",),
    ("cli",),
    ("__main__",),
)
HEIGHT = {name: height for height, layer in enumerate(LAYERS) for name in layer}
MOST_FILES = 22


def modules() -> dict[str, Path]:
    paths = sorted(PACKAGE.rglob("*.py"))
    names = [".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in paths]
    return {name.removesuffix(".__init__"): path for name, path in zip(names, paths, strict=True)}


def imports(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Yield the modules of this package that a module imports, including imports in functions and for types."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == NAME:
            names = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (name if name in known else str(node.module) for name in names)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == NAME)


@pytest.fixture(scope="module")
def graph() -> dict[str, set[str]]:
    known = modules()
    return {name: {found for found in imports(path, known) if found != name} for name, path in known.items()}


def circle(graph: dict[str, set[str]]) -> list[str]:
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_module_imports_what_imports_it_and_a_planted_circle_is_found(graph):
    managers = {name for name in graph if name.startswith(f"{NAME}.managers")}
    assert circle({name: found - managers if name in managers else found for name, found in graph.items()}) == []
    assert set(circle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}})) == {"b", "c"}


def test_imports_go_down(graph):
    upward = []
    for name, found in graph.items():
        here = name.split(".")[1] if "." in name else None
        there = {other.split(".")[1] for other in found if "." in other}
        upward += [f"{name} -> {other}" for other in there if here and HEIGHT[other] > HEIGHT[here]]
    assert upward == []


def test_every_package_has_its_place():
    assert {name.split(".")[1] for name in modules() if "." in name} == set(HEIGHT)


def test_a_folder_holds_one_subject():
    folders = {path.parent for path in PACKAGE.rglob("*.py")} - {PACKAGE / "cli"}  # one file per command
    crowded = {str(folder): len(list(folder.glob("*.py"))) for folder in folders}
    assert {folder: count for folder, count in crowded.items() if count > MOST_FILES} == {}


def test_every_package_declares_its_public_names():
    trees = {str(path): ast.parse(path.read_text()) for path in PACKAGE.rglob("__init__.py")}
    assert [path for path, tree in trees.items() if len(ast.get_docstring(tree) or "") < 80] == []
