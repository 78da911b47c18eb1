"""Run every snippet of the page about other tools, in the order of the page."""

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
NEEDS = {"stable_baselines3": "stable_baselines3", "RecordVideo": "moviepy"}
PAGE = (DOCS / "clients.md").read_text(encoding="utf-8")
SNIPPETS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
# These libraries warn about themselves and about spaces without bounds.
pytestmark = [pytest.mark.filterwarnings("default"), pytest.mark.slow]


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_a_snippet_runs(number, request):
    snippet = SNIPPETS[number]
    for word, library in NEEDS.items():
        if word in snippet and importlib.util.find_spec(library) is None:
            pytest.skip(f"{library} is not installed: nox -s clients")
    if "rgb_array" in snippet:
        request.getfixturevalue("graphics")
    exec(compile(snippet, "docs/clients.md", "exec"), {"np": np})  # the first snippet of the page imports numpy
    if "RecordVideo" in snippet:
        assert Path("videos/rl-video-episode-0.mp4").stat().st_size > 1000


def test_the_page_has_snippets_and_its_table_names_the_tests():
    assert len(SNIPPETS) > 1
    pins = (Path(__file__).parent / "requirements.txt").read_text(encoding="utf-8")
    for name, version in re.findall(r"^([\w-]+)==(\S+)$", pins, re.MULTILINE):
        assert f"{name} {version}" in PAGE
    named = re.findall(r"`(tests/[\w/]+\.py)`", PAGE)
    assert len(named) >= 6
    assert [name for name in named if not (DOCS.parent / name).is_file()] == []
