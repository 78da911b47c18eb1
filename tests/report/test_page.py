import itertools
import re

import pytest

from report.pages import Page
from report.runs import add_play, make_run
from wheelleg_exp.report import make_report
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> RunDirectory:
    run = make_run(tmp_path_factory.mktemp("page") / "runs")
    add_play(run)
    return run


@pytest.fixture(scope="module")
def html(run) -> str:
    return make_report(run.path, run.root, pictures=False).path.read_text()


@pytest.fixture(scope="module")
def found(html) -> Page:
    return Page(html)


def test_nothing_is_fetched_from_anywhere(html, found):
    for element in found.elements:
        for name in ("src", "href", "srcset", "action", "data", "poster", "xlink:href", "background"):
            assert element.attributes.get(name, "#").startswith(("#", "data:")), (element.tag, element.attributes)
    assert not re.search(r"url\((?!#)", html)
    assert not re.search("@import|https?://", html)


def test_there_is_no_script_and_the_page_forbids_them(found):
    assert found.all("script", "iframe", "object", "embed", "form", "base") == []
    assert not [e for e in found.elements for name in e.attributes if name.startswith("on")]
    (policy,) = [e for e in found.all("meta") if e.attributes.get("http-equiv") == "Content-Security-Policy"]
    assert policy.attributes["content"].startswith("default-src 'none'")


def test_elements_nest_and_names_are_unique(found):
    assert (found.wrong, found.open) == ([], [])
    ids = [e.attributes["id"] for e in found.elements if "id" in e.attributes]
    assert len(ids) == len(set(ids))
    assert {e.attributes["href"] for e in found.all("a")} <= {f"#{name}" for name in ids}


def test_the_page_is_accessible(found):
    assert found.all("html")[0].attributes["lang"] == "en"
    levels = [int(e.tag[1]) for e in found.all("h1", "h2", "h3", "h4")]
    assert (levels[0], levels.count(1)) == (1, 1)
    assert all(b - a <= 1 for a, b in itertools.pairwise(levels))
    assert all(e.attributes.get("alt") for e in found.all("img"))
    assert all(e.attributes.get("scope") for e in found.all("th"))
    assert found.drawings
    assert all(e.attributes.get("aria-hidden") == "true" for e in found.all("svg"))
    assert [e.attributes["content"] for e in found.all("meta") if e.attributes.get("name") == "viewport"]


@pytest.mark.usefixtures("drawings_too")
def test_the_same_run_gives_the_same_page(run, html):
    assert make_report(run.path, run.root, pictures=False).path.read_text() == html
