"""Test that the source code lets the environment run on any physics engine and any device."""

import ast
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "wheelleg_exp"
FILES = sorted(path for part in ("sim", "managers", "mdp", "env") for path in (PACKAGE / part).rglob("*.py"))
PHYSX = {"sim/physx/physx_engine.py", "sim/physx/physx_stage.py"}
WARP = {"sim/warp_engine.py", "sim/warp_order.py", "sim/warp_runtime.py"}
ENGINES = {"sim/batch_engine.py", *PHYSX, *WARP}  # A physics engine knows its own device.

FACTORIES = frozenset(
    """arange as_tensor empty eye full linspace logspace normal ones rand randint randn randperm tensor
    zeros""".split()  # noqa: SIM905
)
# These operations read a tensor's value on the host, which waits for the GPU.
READS = frozenset(["all", "any", "item", "tolist"])
DTYPES = frozenset(["double", "float64"])

# These functions may wait for the GPU, because no step calls them: they build, save, restore, or report errors.
NOT_IN_A_STEP = frozenset(
    """__init__ __str__ resolve connect bind exclude _end_failed failures evidence failure require_finite_writes
    load_state_dict state_dict restore save shape_ids set_external_force_and_torque get_active_iterable_terms
    model_digest checked_rays constant _plain _number set_permanent_body_wrench
    _require_order _judge _on_host rolling_signs default_pose _endings record_pre_reset in_world_convention
    add_to""".split()  # noqa: SIM905
)
HOST = {
    "state/values.py": "the door out",
    "managers/return_checks.py": "tells of an array in place of a tensor",
    "sim/engine.py": "reads the compiled model",
    "sim/robot_model.py": "edits the robot before it is compiled",
    "sim/root_frame.py": "edits the robot before it is compiled",
    "sim/scene.py": "digests the compiled model",
    "env/undeclared.py": "looks at a step from outside, once in a training",
    "managers/async_queries.py": "looks at masks that have come to the host",
    "managers/recorder_manager.py": "recorded rows leave the device",
    "managers/curriculum_manager.py": "takes what a user's term returned",
}
GROUNDS = {
    f"sim/terrain/{name}.py": "makes the ground before it is compiled"
    for name in ("relief", "sub_terrains", "terrain_files", "terrain_generator")
}
EXACT = {"mdp/root_motion.py": "a height must agree with that of an exported policy to 1e-6"}


def _name(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def _functions(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Yield every node with the name of the innermost function around it."""

    def walk(node: ast.AST, owner: str) -> Iterator[tuple[str, ast.AST]]:
        for child in ast.iter_child_nodes(node):
            inner = child.name if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)) else owner
            yield inner, child
            yield from walk(child, inner)

    yield from walk(tree, "")


def _called(node: ast.AST) -> str | None:
    return node.func.attr if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) else None


def _without_a_device(_: str, node: ast.AST) -> bool:
    made = isinstance(node, ast.Call) and _called(node) in FACTORIES and ast.unparse(node.func).startswith("torch.")
    return made and not any(word.arg == "device" for word in node.keywords)


def _decides(node: ast.AST) -> ast.expr | None:
    if isinstance(node, (ast.If, ast.While, ast.IfExp, ast.Assert)):
        return node.test
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "bool" and node.args:
        return node.args[0]
    return None


def _branches(owner: str, node: ast.AST) -> bool:
    test = _decides(node)
    return test is not None and owner not in NOT_IN_A_STEP and any(_called(n) in READS for n in ast.walk(test))


def _reads(owner: str, node: ast.AST) -> bool:
    return owner not in NOT_IN_A_STEP and _called(node) in {"item", "tolist"}


def _bridges(_: str, node: ast.AST) -> bool:
    imported = isinstance(node, (ast.Import, ast.ImportFrom)) and "numpy" in ast.unparse(node)
    return imported or _called(node) in {"numpy", "from_numpy"}


def _assumes_doubles(_: str, node: ast.AST) -> bool:
    return isinstance(node, ast.Attribute) and node.attr in DTYPES


def _uses_state_rows(owner: str, node: ast.AST) -> bool:
    is_state = isinstance(node, ast.Attribute) and ast.unparse(node).endswith("sim.state")
    return is_state and owner not in NOT_IN_A_STEP


def _lines(breaks: Callable[[str, ast.AST], bool], code: str) -> list[int]:
    """Return the lines of the code that break a rule."""
    return [node.lineno for owner, node in _functions(ast.parse(code)) if breaks(owner, node)]


RULES = {
    "a tensor is made without env.device": (_without_a_device, {}),
    "a step branches on a tensor's value": (_branches, GROUNDS),
    "a step reads a tensor's value": (_reads, GROUNDS),
    "a tensor goes through numpy": (_bridges, {**HOST, **GROUNDS}),
    "a number is taken for a float64": (_assumes_doubles, {**GROUNDS, **EXACT}),
    "the engine's state is taken for a row": (_uses_state_rows, {}),
}


@pytest.mark.parametrize("rule", RULES)
def test_no_source_of_the_environment_breaks_a_rule(rule):
    breaks, allowed = RULES[rule]
    paths = [path for path in FILES if _name(path) not in {*ENGINES, *allowed}]
    lines = {_name(path): _lines(breaks, path.read_text(encoding="utf-8")) for path in paths}
    assert {name: found for name, found in lines.items() if found} == {}
    # The term of a new project breaks no rule either.
    assert _lines(breaks, (PACKAGE / "project" / "templates" / "terms.py.txt").read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    ("rule", "code"),
    [
        ("a tensor is made without env.device", "def f(n):\n    return torch.zeros(n, 3)"),
        ("a step branches on a tensor's value", "def f(x):\n    if (x > 0).any():\n        x += 1"),
        ("a step branches on a tensor's value", "def f(x):\n    return bool(x.all())"),
        ("a step reads a tensor's value", "def f(x):\n    return x.sum().item()"),
        ("a tensor goes through numpy", "def f(x):\n    return x.numpy()"),
        ("a tensor goes through numpy", "import numpy as np"),
        ("a number is taken for a float64", "def f(x):\n    return x.double()"),
        ("the engine's state is taken for a row", "def f(env):\n    return env.scene.sim.state[:, 7:13]"),
    ],
)
def test_each_rule_finds_what_it_is_for(rule, code):
    assert _lines(RULES[rule][0], code)
