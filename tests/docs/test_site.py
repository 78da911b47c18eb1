"""The manual as a site: one overview of the results, a search that splits keys, and nothing from other hosts."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def test_the_overview_lists_every_page_of_results():
    folder = ROOT / "docs/results"
    linked = set(re.findall(r"\((\w+)\.md\)", (folder / "README.md").read_text(encoding="utf-8")))
    assert linked == {path.stem for path in folder.glob("*.md")} - {"README"}
    assert {path.stem for path in folder.glob("*.json")} == linked - {"realism"}  # Trials have no records
    assert (ROOT / "mkdocs.yml").read_text(encoding="utf-8").count(" results/") == 2  # The overview, and not_in_nav.


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = pytest.importorskip("mkdocs.config")
    from mkdocs.commands.build import build

    folder = tmp_path_factory.mktemp("site")
    build(config.load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


@pytest.mark.slow
def test_the_site_is_searched_by_parts_of_keys_and_loads_nothing_from_other_hosts(site: Path):
    index = json.loads((site / "search/search_index.json").read_text(encoding="utf-8"))
    words = re.split(index["config"]["separator"], "agent.algorithm.entropy_coef=0.01 W&amp;B")
    assert {"entropy", "coef", "W", "B"} <= set(words)
    loads = re.compile(r"<(?:script|img|iframe|link)[^>]*(?:src|href)=[\"']?(?:https?:)?//|url\([\"']?(?:https?:)?//")
    pages = [path for suffix in ("html", "css") for path in site.rglob(f"*.{suffix}")]
    assert len(pages) > 50
    assert [path.name for path in pages if loads.search(path.read_text(encoding="utf-8"))] == []
    recipes = (site / "recipes.html").read_text(encoding="utf-8")
    assert '<span class="nt">defaults</span>' in recipes  # Pygments has coloured a YAML key.


@pytest.mark.slow
def test_the_index_for_language_models_lists_every_page_of_the_navigation_with_a_sentence(site: Path):
    text = (site / "llms.txt").read_text(encoding="utf-8")
    assert text.startswith("# wheelleg_exp\n\n> ")
    found = re.findall(r"^- \[(.+)\]\((.+)\): (.{15,})$", text, re.MULTILINE)
    named = re.findall(r"^ +- .*?([\w./]+)\.md$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert [path.removesuffix(".html") for _, path, _ in found] == [name.replace("README", "index") for name in named]
    assert [path for _, path, _ in found if not (site / path).is_file()] == []
