import re
from xml.etree import ElementTree

import pytest

from wheelleg_exp.report.inline_svg import clean

HEAD = '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" width="90pt" height="60pt">'


def _parsed(body: str) -> ElementTree.Element:
    return ElementTree.fromstring(clean(f"{HEAD}{body}</svg>", "p", "title"))


@pytest.mark.parametrize("body", [
    "<script>alert(1)</script>", "<foreignObject><b/></foreignObject>", "<style>@import url(http://x)</style>",
    '<image href="http://x/y.png"/>', '<a href="javascript:alert(1)"><text>x</text></a>', "<animate/>",
])  # fmt: skip
def test_elements_that_run_or_fetch_something_are_dropped(body):
    assert list(_parsed(body)) == []


@pytest.mark.parametrize("attribute", [
    'onload="alert(1)"', 'href="http://x"', 'style="fill: url(http://x)"', 'style="fill: url(&quot;//x&quot;)"',
    'fill="url(data:x)"',
])  # fmt: skip
def test_attributes_that_run_or_fetch_something_are_dropped(attribute):
    (rect,) = _parsed(f"<rect {attribute}/>")
    assert rect.attrib == {}


def test_names_get_the_prefix_and_references_follow():
    body = '<defs><clipPath id="c"/><path id="m"/></defs><g clip-path="url(#c)"><use xlink:href="#m"/></g>'
    text = ElementTree.tostring(_parsed(body), encoding="unicode")
    assert set(re.findall(r'id="([^"]+)"', text)) == {"p-c", "p-m"}
    assert 'clip-path="url(#p-c)"' in text
    assert 'href="#p-m"' in text


def test_a_drawing_scales_has_a_label_and_escapes_text():
    svg = _parsed("<text>&lt;script&gt;alert(1)&lt;/script&gt;</text>")
    assert (svg[0].text, svg.get("viewBox")) == ("<script>alert(1)</script>", "0 0 90 60")
    assert (svg.get("role"), svg.get("aria-label")) == ("img", "title")
    for text in ("", "<html/>", "<svg>"):
        with pytest.raises(ValueError, match="not SVG"):
            clean(text, "p", "t")
