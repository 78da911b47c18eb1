import re
from pathlib import Path

import numpy as np
import pytest

from browser.chrome import Chrome
from wheelleg_exp.report import make_report
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.browser

_BOXES = """
return [...document.querySelectorAll(arguments[0] || 'SELECTOR')].map(e => {
  const box = e.getBoundingClientRect();
  return [box.width, box.height, box.left, box.right];
});
"""


def _boxes(chrome: Chrome, selector: str) -> list[list[float]]:
    return chrome.script(_BOXES.replace("SELECTOR", selector))


@pytest.fixture(scope="module")
def report(played: RunDirectory) -> Path:
    made = make_report(played.path, played.root)
    if made.notes:
        pytest.skip(f"{made.notes[0]} (Debian: apt install libegl1 libgl1-mesa-dri or libosmesa6)")
    assert made.size < 3_000_000
    return made.path


@pytest.fixture(params=[375, 768, 1280], ids=["phone", "tablet", "desk"])
def width(request: pytest.FixtureRequest, chrome: Chrome, report: Path) -> int:
    chrome.size(request.param)
    chrome.open(report.as_uri())
    return request.param


def test_pictures_and_plots_are_on_screen(chrome: Chrome, width: int):
    shown = chrome.script("return [...document.images].map(i => [i.complete, i.naturalWidth, i.clientWidth])")
    assert len(shown) >= 9  # The report has a first picture, four of the play, and four of each sample.
    assert all(complete and natural > 0 and 0 < client <= width for complete, natural, client in shown)
    chrome.script("document.querySelectorAll('details').forEach(d => d.open = true)")
    plots = _boxes(chrome, "figure.plot img")
    assert len(plots) > 10
    assert all(w > 250 and h > 100 for w, h, _, _ in plots)


def test_nothing_is_wider_than_the_screen(chrome: Chrome, width: int):
    chrome.script("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert chrome.script("return document.documentElement.scrollWidth") <= width
    for left, right in [box[2:] for box in _boxes(chrome, "main > section, figure, .card, p, dl, pre, .scroll")]:
        assert left >= 0
        assert right <= width + 0.5
    smallest = chrome.script(
        "return Math.min(...[...document.querySelectorAll('main *')]"
        ".filter(e => e.textContent.trim() && !e.closest('svg'))"
        ".map(e => parseFloat(getComputedStyle(e).fontSize)))"
    )
    assert smallest >= 12
    # A plot's letters of 8.5 px are readable if the browser does not shrink the plot.
    scales = chrome.script(
        "return [...document.querySelectorAll('figure.plot img')].map(i => i.clientWidth / i.getAttribute('width'))"
    )
    assert scales
    assert min(scales) >= 1.0


@pytest.mark.parametrize("px", [320, 375, 560, 768, 1000, 1280])
def test_no_number_is_cut_off_by_the_box_that_it_stands_in(chrome: Chrome, report: Path, px: int):
    chrome.size(px)
    chrome.open(report.as_uri())
    chrome.script("document.querySelectorAll('details').forEach(d => d.open = true)")
    cut = chrome.script(
        "return [...document.querySelectorAll('.scroll, .card, pre')].filter(e => e.scrollWidth > e.clientWidth + 1)"
        ".map(e => (e.ariaLabel || e.className) + ` ${e.scrollWidth} > ${e.clientWidth}`)"
    )
    assert cut == []


def test_the_browser_reports_no_error_loads_nothing_and_shows_the_robot(chrome: Chrome, report: Path):
    chrome.size(1280)
    chrome.open(report.as_uri())
    chrome.script("return document.images.length")
    assert chrome.errors() == []
    assert chrome.requests() == [report.as_uri()]
    left, top, right, bottom = chrome.script(
        "const b = document.querySelector('.hero img').getBoundingClientRect();"
        "return [b.left, b.top, b.right, b.bottom]"
    )
    hero = chrome.picture()[int(top) : int(bottom), int(left) : int(right)].astype(int)
    # The robot is orange, and the floor is grey.
    orange = (hero[..., 0] - hero[..., 2] > 60) & (hero[..., 0] > hero[..., 1])
    assert 0.01 < np.mean(orange) < 0.5


def test_on_paper_there_are_pages_with_everything_on_them(chrome: Chrome, report: Path):
    chrome.size(1280)
    chrome.open(report.as_uri())
    pdf = chrome.pdf()
    assert pdf.startswith(b"%PDF")
    pages = len(re.findall(rb"/Type\s*/Page\b", pdf))
    assert 3 <= pages <= 20
    (box,) = set(re.findall(rb"/MediaBox\s*\[([^\]]+)\]", pdf))
    assert [round(float(x)) for x in box.split()] == [0, 0, 595, 842]  # A4, in points
    chrome.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    try:
        hidden = chrome.script(
            "return [...document.querySelectorAll('details > *:not(summary)')].filter(e => !e.checkVisibility()).length"
        )
        assert hidden == 0
    finally:
        chrome.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
