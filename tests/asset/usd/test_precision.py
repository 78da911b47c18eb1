"""The MJCF has shortest decimals for single-precision numbers of a USD file, and exact double-precision numbers."""

import re

import numpy as np
import pytest

from ..small_usd import converted, hinge, link, write

CUBE = 'def Cube "c" (prepend apiSchemas = ["PhysicsCollisionAPI"])\n{{\n double size = 0.2\n{0}\n}}\n'
PLACE = '{0}3 xformOp:translate = ({1}, 0, 0)\n uniform token[] xformOpOrder = ["xformOp:translate"]'
THIRD = 1 / 3


def text_of(folder, inside: str, **values: str) -> str:
    frame = f"point3f physics:localPos0 = (1, 0, 0)\n {values.get('text', '')}"
    body = link("a", inside=inside) + link("b", "(1, 0, 0)") + hinge("j", "a", "b", text=frame)
    _, done = converted(write(folder, body))
    return done.output.read_text()


def test_limits_and_gains_are_the_shortest_that_read_back_the_same(tmp_path):
    text = "float physics:lowerLimit = -11.1\n float physics:upperLimit = 79.9998\n"
    text += 'float drive:angular:physics:stiffness = 0.3333333\n uniform token drive:angular:physics:type = "force"'
    written = text_of(tmp_path, "", text=text)
    low, high = (float(v) for v in re.search(r'range="(\S+) (\S+)"', written).groups())
    for found, degrees in ((low, -11.1), (high, 79.9998)):
        assert np.float32(found) == np.float32(np.radians(float(str(np.float32(degrees)))))
        assert len(repr(found)) <= 11
    kp = re.search(r'kp="(\S+)"', written).group(1)
    assert np.float32(kp) == np.float32(np.degrees(0.3333333))
    assert len(kp) <= 10


def test_transforms_that_are_single_are_short(tmp_path):
    widened = repr(float(np.float32(THIRD)))
    for kind in ("float", "double"):
        written = text_of(tmp_path, CUBE.format(PLACE.format(kind, widened)))
        assert 'pos="0.33333334 0 0"' in written


def test_transforms_in_double_precision_lose_nothing(tmp_path):
    written = text_of(tmp_path, CUBE.format(PLACE.format("double", repr(THIRD))))
    found = float(re.search(r'<geom name="a_c"[^>]* pos="(\S+) 0 0"', written).group(1))
    assert found == pytest.approx(THIRD, rel=1e-14)


def test_a_range_of_mujocos_schema_is_double_and_stays(tmp_path):
    text = "double mjc:armature = 0.1234567890123"
    assert 'armature="0.1234567890123"' in text_of(tmp_path, "", text=text)
