"""Find when a condition is true in a recording, such as ``base.pitch > 0.3 and rewards.total < -5``.

A condition is written like a Python expression of names, numbers, comparisons, ``and``, ``or``, ``not``,
``+ - * /``, parentheses, and ``abs(…)``. It is parsed, and never run as code. A name that is not a Python name, such
as ``joints.left-hip.effort``, is quoted. A name alone is true where its number is not zero. A comparison with NaN
is never true.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.recorded_numbers import Frames, Moment, frames_for
from wheelleg_exp.inspection.row_selection import Length, Selection, nothing_chosen
from wheelleg_exp.recording.layout import STEP
from wheelleg_exp.recording.reading.recording_reader import Recording

LONGEST = 2000
DEEPEST = 60
_SHOWN = 120  # letters of a wrong condition
_COMPARE: dict[type, Callable[[Any, Any], Any]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_ARITHMETIC: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_EXPECTED = "names, numbers, < <= > >= == !=, and, or, not, + - * /, ( ) and abs( )"
Value = NDArray | float


class Condition:
    """A parsed condition.

    Raises:
        WheellegError: the text is not a condition.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        self._tree = _parsed(text)
        _require_known(self._tree, text)
        self.names = list(dict.fromkeys(_names(self._tree)))
        if not self.names:
            raise _wrong(text, "it contains no recorded name")

    def holds(self, values: Mapping[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
        """Return where the condition is true, (n,), given the values (n,) of each of ``names``."""
        rows = len(values[self.names[0]])
        with np.errstate(all="ignore"):
            return np.broadcast_to(_truth(_value(self._tree, values)), (rows,)).copy()


def _parsed(text: str) -> ast.expr:
    if len(text) > LONGEST:
        raise _wrong(text, f"it has more than {LONGEST} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        hint = "; '==' compares" if "=" in text.replace("==", "").replace("<=", "").replace(">=", "") else ""
        raise _wrong(text, f"it cannot be read ({getattr(error, 'msg', None) or 'too deep'}{hint})") from error
    # The functions below recurse, so a deep tree must be refused before Python's recursion limit.
    if _depth(tree) > DEEPEST:
        raise _wrong(text, "it is nested too deeply")
    return tree


def _depth(tree: ast.AST) -> int:
    """Return the depth of a tree, computed without recursion."""
    depth, level = 0, [tree]
    while level:
        depth, level = depth + 1, [child for node in level for child in ast.iter_child_nodes(node)]
    return depth


def _require_known(node: ast.expr, text: str) -> None:
    """Raise WheellegError unless the tree only has operations that conditions allow."""
    if _name(node) is not None or _is_number(node):
        return
    parts = _parts(node)
    if parts is None:
        raise _wrong(text, f"'{ast.unparse(node)}' is not allowed")
    for part in parts:
        _require_known(part, text)


def _parts(node: ast.expr) -> list[ast.expr] | None:
    """Return the operands of an operation; None if the operation is not allowed."""
    match node:
        case ast.BoolOp(values=values):
            return values
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.UAdd(), operand=operand):
            return [operand]
        case ast.BinOp(left=left, op=op, right=right) if type(op) in _ARITHMETIC:
            return [left, right]
        case ast.Compare(left=left, ops=ops, comparators=others) if all(type(op) in _COMPARE for op in ops):
            return [left, *others]
        case ast.Call(func=ast.Name(id="abs"), args=[one], keywords=[]):
            return [one]
    return None


def _names(node: ast.expr) -> Iterator[str]:
    name = _name(node)
    if name is not None:
        yield name
        return
    for part in _parts(node) or ():
        yield from _names(part)


def _name(node: ast.expr) -> str | None:
    """Return the name that a node stands for: ``a``, ``a.b``, ``a.b[c]``, or a quoted text."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    inner = node
    while isinstance(inner, (ast.Attribute, ast.Subscript)):
        inner = inner.value
    return ast.unparse(node) if isinstance(inner, ast.Name) else None


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float))


def _value(node: ast.expr, values: Mapping[str, NDArray[np.float64]]) -> Value:
    name = _name(node)
    if name is not None:
        return values[name]
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    parts = [_value(part, values) for part in _parts(node) or ()]
    match node:
        case ast.BoolOp(op=ast.And()):
            return _all(parts)
        case ast.BoolOp():
            return _any(parts)
        case ast.UnaryOp(op=ast.Not()):
            return np.logical_not(_truth(parts[0])).astype(np.float64)
        case ast.UnaryOp(op=ast.USub()):
            return -parts[0]
        case ast.BinOp(op=op):
            return _ARITHMETIC[type(op)](np.asarray(parts[0], dtype=np.float64), parts[1])
        case ast.Compare(ops=ops):
            steps = zip(ops, parts[:-1], parts[1:], strict=True)
            return _all([_known(a, b) & _COMPARE[type(op)](a, b) for op, a, b in steps])
        case ast.Call():
            return np.abs(parts[0])
    return parts[0]


def _truth(value: Value) -> NDArray[np.bool_]:
    return (np.asarray(value) != 0) & ~np.isnan(value)


def _known(a: Value, b: Value) -> NDArray[np.bool_]:
    return ~(np.isnan(a) | np.isnan(b))


def _all(parts: list[Any]) -> Value:
    result = _truth(parts[0])
    for part in parts[1:]:
        result = result & _truth(part)
    return result.astype(np.float64)


def _any(parts: list[Any]) -> Value:
    result = _truth(parts[0])
    for part in parts[1:]:
        result = result | _truth(part)
    return result.astype(np.float64)


def _wrong(text: str, reason: str) -> WheellegError:
    shown = text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
    return WheellegError(f"'{shown}' is not a condition: {reason}", key="--where", expected=_EXPECTED)


@dataclass(frozen=True)
class Hit:
    """Consecutive frames in which a condition is true.

    ``around`` are the rows from before the first to after the last frame; None unless requested.
    """

    first: Moment
    last: Moment
    frames: int
    around: Frames | None


def find_hits(
    recording: Recording,
    condition: Condition,
    *,
    columns: Sequence[str] = (),
    around: Length | None = None,
    selection: Selection | None = None,
) -> list[Hit]:
    """Return the stretches in which a condition is true, by environment and time.

    Args:
        recording: the recording.
        condition: the condition.
        columns: the numbers of the surrounding rows; by default those of the condition.
        around: time before and after each stretch.
        selection: the rows to search; surrounding rows can be outside.

    Raises:
        WheellegError: a name is wrong, or no row is selected.
    """
    chosen = selection or Selection()
    wanted = list(dict.fromkeys([*condition.names, *columns]))
    # Read all rows of the environment, because surrounding rows can be outside the selection.
    everything = frames_for(recording, wanted, Selection(env_id=chosen.env_id), key="--where")
    if not chosen.is_all and not any(len(chosen.apply(frames.table)) for frames in everything):
        raise nothing_chosen(recording)
    reach = None if around is None else around.steps(recording.step_dt)
    return [hit for frames in everything for hit in _hits(frames, condition, chosen, reach, columns)]


def _hits(
    frames: Frames, condition: Condition, selection: Selection, reach: int | None, columns: Sequence[str]
) -> list[Hit]:
    holds = condition.holds({name: frames.column(name) for name in condition.names})
    steps = frames.column(STEP)
    holds &= np.isin(steps, np.asarray(selection.apply(frames.table).column(STEP)))
    shown = _only(frames, list(columns) or condition.names)
    return [
        Hit(
            first=frames.moment(a),
            last=frames.moment(b),
            frames=b - a + 1,
            around=None if reach is None else shown.filter((steps >= steps[a] - reach) & (steps <= steps[b] + reach)),
        )
        for a, b in _stretches(holds, steps)
    ]


def _stretches(holds: NDArray[np.bool_], steps: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Return the first and last row of each stretch of consecutive frames."""
    rows = np.flatnonzero(holds)
    if not len(rows):
        return []
    breaks = np.flatnonzero((np.diff(rows) != 1) | (np.diff(steps[rows]) > 1)) + 1
    return [(int(part[0]), int(part[-1])) for part in np.split(rows, breaks)]


def _only(frames: Frames, names: Sequence[str]) -> Frames:
    times = [name for name in frames.table.column_names if name not in frames.names]
    return Frames(frames.table.select([*times, *dict.fromkeys(names)]), frames.env_id)
