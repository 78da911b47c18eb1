import math

import pytest

from wheelleg_exp.report import value_format


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((24.5648, "24.6"), (-0.0479, "−0.0479"), (0.0, "0.00"), (1234.5, "1234"), (12345, "12 345"), (-3, "−3")),
        *((-6.74e-5, "−6.74×10⁻⁵"), (2.5e12, "2.50×10¹²")),
        *((math.nan, "–"), (math.inf, "infinite"), (None, "–"), ("many", "many")),
    ],
)
def test_numbers_have_three_digits_and_whole_ones_all(value, text):
    assert value_format.number(value) == text


def test_nan_in_a_json_file_becomes_null():
    assert value_format.numbers({"a": {"b": "nan"}, "c": math.nan, "d": 1.5}) == {"a": {"b": None}, "c": None, "d": 1.5}
    assert [value_format.exact(v) for v in (5.0, -50.0, 0.07)] == ["5", "−50", "0.07"]
    assert len(value_format.brief("x" * 1000)) < 200


PERCENT = [(1.0, "100 %"), (0.9999, "99.9 %"), (0.0, "0 %"), (1e-6, "0.1 %")]  # never rounded to all or nothing
DURATION = [(0.5, "0.50 s"), (42, "42 s"), (157.2, "2 min 37 s"), (3600, "1 h 0 min"), (200000, "2 d 7 h")]
SIZE = [(47, "47 B"), (2186, "2.19 kB"), (948898, "949 kB"), (4765257, "4.77 MB")]


@pytest.mark.parametrize(("kind", "rows"), {"percent": PERCENT, "duration": DURATION, "size": SIZE}.items())
def test_shares_durations_and_sizes_are_short_and_have_units(kind, rows):
    assert [getattr(value_format, kind)(value) for value, _ in rows] == [text for _, text in rows]
