"""Find the times at which a condition such as ``base.pitch > 0.3 and rewards.total < -5`` is true in a recording.

A condition is an expression in Python syntax with names, numbers, comparisons, ``and``, ``or``, ``not``, ``+ - * /``,
parentheses, and ``abs(…)``. The text of a condition is never passed to Python's ``eval``. Names that are invalid in
Python, such as ``joints.left-hip.effort``, must be quoted. A condition that is only the name of a recorded number is
true in rows where this number is not zero. A comparison with NaN is always false.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import cast

import numpy as np
from numpy.typing import NDArray

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection.recorded_numbers import Frames, Moment, frames_for
from wheelleg_exp.inspection.row_selection import Length, Selection, nothing_chosen
from wheelleg_exp.recording.layout import STEP
from wheelleg_exp.recording.reading.recording_reader import Recording

LONGEST = 2000
DEEPEST = 60
_SHOWN = 120  # Error messages show at most 120 characters of the condition after `--where`.
Numbers = NDArray[np.float64]
Value = Numbers | float
_COMPARE: dict[type, Callable[[Value, Value], NDArray[np.bool_]]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_ARITHMETIC: dict[type, Callable[[Value, Value], Value]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
}
_EXPECTED = "names, numbers, < <= > >= == !=, and, or, not, + - * /, ( ) and abs( )"


class Condition:
    """A condition on recorded numbers, parsed from text. ``Condition`` raises WheellegError for invalid text."""

    def __init__(self, text: str) -> None:
        self.text, self._tree = text, _parsed(text)
        self.names = list(dict.fromkeys(_names(self._tree, text)))
        if not self.names:
            raise _wrong(text, "it contains no recorded name")

    def holds(self, values: Mapping[str, NDArray[np.float64]]) -> NDArray[np.bool_]:
        """Return whether the condition is true in each of n rows, (n,); ``values`` maps each name to n values, (n,)."""
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
    # A deeply nested condition would exceed Python's recursion limit, because the evaluation is recursive.
    depth, level = 0, [cast("ast.AST", tree)]
    while level:
        depth, level = depth + 1, [child for node in level for child in ast.iter_child_nodes(node)]
    if depth > DEEPEST:
        raise _wrong(text, "it is nested too deeply")
    return tree


def _parts(node: ast.expr) -> list[ast.expr] | None:
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


def _names(node: ast.expr, text: str) -> Iterator[str]:
    name, parts = _name(node), _parts(node)
    if name is not None:
        yield name
    elif parts is not None:
        for part in parts:
            yield from _names(part, text)
    elif not (isinstance(node, ast.Constant) and isinstance(node.value, (bool, int, float))):
        raise _wrong(text, f"'{ast.unparse(node)}' is not allowed")


def _name(node: ast.expr) -> str | None:
    """Return the name of a recorded number, such as ``base.pitch``, from a Python syntax node; None for other nodes."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    inner = node
    while isinstance(inner, (ast.Attribute, ast.Subscript)):
        inner = inner.value
    return ast.unparse(node) if isinstance(inner, ast.Name) else None


def _value(node: ast.expr, values: Mapping[str, NDArray[np.float64]]) -> Value:
    name = _name(node)
    if name is not None:
        return values[name]
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        return float(node.value)
    parts = [_value(part, values) for part in _parts(node) or ()]
    match node:
        case ast.BoolOp(op=op):
            join = np.logical_and if isinstance(op, ast.And) else np.logical_or
            return np.asarray(reduce(join, map(_truth, parts)), dtype=np.float64)
        case ast.UnaryOp(op=ast.Not()):
            return np.logical_not(_truth(parts[0])).astype(np.float64)
        case ast.UnaryOp(op=ast.USub()):
            return -parts[0]
        case ast.BinOp(op=op):
            return _ARITHMETIC[type(op)](np.asarray(parts[0], dtype=np.float64), parts[1])
        case ast.Compare(ops=ops):
            steps = zip(ops, parts[:-1], parts[1:], strict=True)
            found = (~(np.isnan(a) | np.isnan(b)) & _COMPARE[type(op)](a, b) for op, a, b in steps)
            return np.asarray(reduce(np.logical_and, found), dtype=np.float64)
        case ast.Call():
            return np.abs(parts[0])
    return parts[0]


def _truth(value: Value) -> NDArray[np.bool_]:
    return np.asarray((np.asarray(value) != 0) & ~np.isnan(value))


def _wrong(text: str, reason: str) -> WheellegError:
    shown = text if len(text) <= _SHOWN else text[: _SHOWN - 1] + "…"
    return WheellegError(f"'{shown}' is not a condition: {reason}", key="--where", expected=_EXPECTED)


@dataclass(frozen=True)
class Hit:
    """Consecutive frames in which a condition is true, and the frames around them, None if not requested."""

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
    """Return all groups of consecutive frames in which a condition is true, sorted by environment and time.

    ``columns`` names the recorded numbers in ``Hit.around``; by default, these are the numbers in the condition. With
    ``around`` of 0.5 s, for example, ``Hit.around`` contains the hit's frames and 0.5 s before and after the hit.
    """
    chosen = selection or Selection()
    wanted = list(dict.fromkeys([*condition.names, *columns]))
    # Read all recorded times, because requested frames around a hit can be outside the times that the user selected.
    everything = frames_for(recording, wanted, Selection(env_id=chosen.env_id), key="--where")
    if not chosen.is_all and not any(len(chosen.apply(frames.table)) for frames in everything):
        raise nothing_chosen(recording)
    reach = None if around is None else around.steps(recording.step_dt)
    hits = []
    for frames in everything:
        holds = condition.holds({name: frames.column(name) for name in condition.names})
        steps = frames.steps
        rows = np.flatnonzero(holds & np.isin(steps, np.asarray(chosen.apply(frames.table).column(STEP))))
        times = [name for name in frames.table.column_names if name not in frames.names]
        shown = Frames(frames.table.select([*times, *dict.fromkeys(columns or condition.names)]), frames.env_id)
        breaks = np.flatnonzero((np.diff(rows) != 1) | (np.diff(steps[rows]) > 1)) + 1
        for part in np.split(rows, breaks) if len(rows) else ():
            a, b = int(part[0]), int(part[-1])
            near = None if reach is None else (steps >= steps[a] - reach) & (steps <= steps[b] + reach)
            around_hit = None if near is None else shown.filter(near)
            hits.append(Hit(frames.moment(a), frames.moment(b), b - a + 1, around_hit))
    return hits
