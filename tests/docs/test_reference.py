"""The pages that are made from the stock files: they are what the files say now, and leave no key without a meaning."""

import runpy
from pathlib import Path

import pytest

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.explaining import catalog
from wheelleg_exp.config.tree_lookup import leaves
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.terms.key_syntax import dotted

DOCS = Path(__file__).resolve().parents[2] / "docs"


@pytest.fixture(scope="module")
def made() -> dict[str, str]:
    return runpy.run_path(str(DOCS / "make_reference.py"))["pages"]()


@pytest.mark.parametrize("name", ["tables/reference.md", "terms.md", "rules.md", "figures.md", "tables/modules.md"])
def test_a_page_matches_the_files(made, name):
    kept = (DOCS / name).read_text(encoding="utf-8")
    assert kept == made[name], "run: python docs/make_reference.py"


def test_every_stock_file_is_reachable(made):
    for file in configs_dir().rglob("*.yaml"):
        assert f"(../../configs/{file.relative_to(configs_dir()).as_posix()})" in made["tables/reference.md"]


def test_every_key_of_every_file_has_a_meaning(made):
    rows = [line for line in made["tables/reference.md"].splitlines() if line.startswith("| `")]
    assert len(rows) > 150
    assert [row for row in rows if row.rsplit("|", 2)[1].strip() == ""] == []


def test_every_term_with_a_stock_file_is_in_the_library(made):
    for entry in catalog.terms():
        assert f"`{entry.name}`" in made["terms.md"]


def test_a_key_is_the_one_of_a_composed_config(made):
    composed = [dotted(keys) for keys, _ in leaves(compose(["task=stand"]).config)]
    env = [key for key in composed if key.startswith(("env.rewards.", "env.events.", "env.sim.", "agent.algorithm."))]
    assert len(env) > 60
    assert [key for key in env if f"| `{key}` |" not in made["tables/reference.md"]] == []
