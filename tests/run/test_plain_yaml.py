import enum
import math
import random
import struct

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.plain_data import dump_yaml

FLOATS = [1e-5, 0.008333333333333333, 1e16, 1e22, -2.5e-300, 5e-324, 0.1 + 0.2, 1e20, -0.0, 1.0]
FLOATS += [math.inf, -math.inf]
TEXTS = ["1e-5", "1e5", "1.0", "yes", "no", "null", "~", "", " x ", "a: b", "# c", "1:30", "0x1f", "0o17"]
TEXTS += ["1_000", "2026-01-31", ".*_wheel", "[a]", "{b}", "*", "&a", "!t", "%", "@", "`", "a\nb\n", "\ttab"]
TEXTS += ["ünï", "\x85", "a\u2028b", "a\rb", "a\r\n", "\ufeff", "-", "inf", ".inf", "nan", ".nan", "on", "="]
TEXTS += ["<<", "'", '"', "x" * 300, "true", "+1.", ".5", "1.e3", "word " * 60, "\x00\x07", "😀"]


def test_floats_survive_to_the_last_bit():
    draw = random.Random(0)
    values = [*FLOATS, *(struct.unpack("d", draw.randbytes(8))[0] for _ in range(2000))]
    values = [v for v in values if not math.isnan(v)]
    read = yaml.safe_load(dump_yaml(values))
    assert [(type(x), struct.pack("d", x)) for x in read] == [(float, struct.pack("d", x)) for x in values]
    assert math.isnan(yaml.safe_load(dump_yaml([float("nan")]))[0])


@pytest.mark.parametrize("value", [None, True, False, 0, -7, 10**20, [], {}, [[], {}], [None, [True]]])
def test_other_plain_values_survive_with_their_types(value):
    read = yaml.safe_load(dump_yaml({"x": value}))["x"]
    assert read == value
    assert type(read) is type(value)


@pytest.mark.parametrize("text", TEXTS)
def test_text_stays_text_for_omegaconf_too(text):
    assert yaml.safe_load(dump_yaml({"x": text, text: 1})) == {"x": text, text: 1}
    assert OmegaConf.to_container(OmegaConf.create(dump_yaml({"x": text}))) == {"x": text}


def test_a_value_used_twice_is_written_twice_and_keys_stay_in_order():
    shared = {"y": [1, 2], "b": 2}
    text = dump_yaml({"z": shared, "a": shared, "m": 3})
    assert "&" not in text
    assert "*" not in text
    read = yaml.safe_load(text)
    assert (list(read), list(read["a"])) == (["z", "a", "m"], ["y", "b"])


class Colour(enum.StrEnum):
    RED = "red"


VALUES = [np.float64(1.0), np.arange(2), (1, 2), {1}, object(), Colour.RED, OmegaConf.create({"a": 1})]
REFUSED = [({"x": [0, value]}, r"env\.x\[1\]: .* cannot be saved as plain YAML") for value in VALUES]
REFUSED += [({key: 1}, "env: the key .* is neither text nor an integer") for key in (True, None, 1.5, (1,))]


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_values_and_keys_that_are_not_plain_are_refused(content, message):
    with pytest.raises(RunDirectoryError, match=message):
        dump_yaml({"env": content})
