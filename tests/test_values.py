"""Test whether a YAML value fits an annotation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Optional

import pytest

from wheelleg_exp.terms.config_values import describe, fits


@dataclass
class Nested:
    x: int


@pytest.mark.parametrize(
    ("annotation", "fitting", "others"),
    [
        (int, [1], [True, 1.0, "1"]),
        (float, [1, 1.5], [True, "abc"]),
        (bool, [True], [1]),
        (str, ["a"], [None, 1]),
        (Path, ["a/b"], []),
        (int | None, [None], []),
        (Optional[str], [None], []),  # noqa: UP045
        (list[float], [[1, 2.0]], []),
        (list[str], [], ["a"]),
        (list[int], [], [[1, "a"]]),
        (tuple[float, float], [[1.0, 2.0]], [[1.0], [1.0, True]]),
        (tuple[int, ...], [[1, 2, 3]], []),
        (str | Sequence[str], [["a"]], []),
        (dict[str, float], [{"a": 1}], [{"a": "b"}]),
        (dict[str, int], [], [[1]]),
        (Mapping[str, Any], [{"a": {"b": 1}}], []),
        (Literal["x", "y"], ["x"], ["z"]),
        (Literal[1], [], [True]),
        (Nested, [{"_target_": "nested", "x": 1}, Nested(1)], [3, {"x": 1}]),
        (Callable[..., Any], ["anything"], []),
        (Any, [3], []),
    ],
)
def test_a_value_fits_an_annotation_or_does_not(annotation, fitting, others):
    assert [value for value in fitting if not fits(value, annotation)] == []
    assert [value for value in others if fits(value, annotation)] == []


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (int, "a whole number"),
        (float | None, "a number or null"),
        (Literal["x", "y"], "one of x, y"),
        (list[str], "a list, each text"),
        (tuple[float, float], "a list of a number, a number"),
        (dict[str, float], "a mapping, each value a number"),
        (dict[str, Any], "a mapping"),
        (bool, "true or false"),
    ],
)
def test_an_annotation_is_described_in_words(annotation, words):
    assert describe(annotation) == words
