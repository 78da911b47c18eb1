"""Test whether a YAML value fits an annotation."""

from __future__ import annotations

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
    ("value", "annotation"),
    [
        (1, int),
        (1, float),
        (1.5, float),
        (True, bool),
        ("a", str),
        ("a/b", Path),
        (None, int | None),
        (None, Optional[str]),  # noqa: UP045
        ([1, 2.0], list[float]),
        ([1.0, 2.0], tuple[float, float]),
        ([1, 2, 3], tuple[int, ...]),
        (["a"], str | Sequence[str]),
        ({"a": 1}, dict[str, float]),
        ({"a": {"b": 1}}, Mapping[str, Any]),
        ("x", Literal["x", "y"]),
        ({"_target_": "nested", "x": 1}, Nested),
        (Nested(1), Nested),
        ("anything", Callable[..., Any]),
        (3, Any),
    ],
)
def test_a_value_fits(value, annotation):
    assert fits(value, annotation)


@pytest.mark.parametrize(
    ("value", "annotation"),
    [
        (True, int),
        (True, float),
        (1, bool),
        (1.0, int),
        ("1", int),
        ("abc", float),
        (None, str),
        (1, str),
        ("a", list[str]),
        ([1, "a"], list[int]),
        ([1.0], tuple[float, float]),
        ([1.0, True], tuple[float, float]),
        ({"a": "b"}, dict[str, float]),
        ([1], dict[str, int]),
        ("z", Literal["x", "y"]),
        (True, Literal[1]),
        (3, Nested),
        ({"x": 1}, Nested),
    ],
)
def test_a_value_does_not_fit(value, annotation):
    assert not fits(value, annotation)


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
def test_an_annotation_is_told_in_words(annotation, words):
    assert describe(annotation) == words
