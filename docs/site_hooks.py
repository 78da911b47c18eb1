"""MkDocs hooks: README.md becomes the first page, links to source files become plain code, and llms.txt is written."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files
from mkdocs.structure.nav import Navigation

ROOT = Path(__file__).resolve().parents[1]
# [`text`](../wheelleg_exp/x.py), also from a folder below docs/
OUTSIDE = re.compile(r"\[([^\]]+)\]\((?:\.\./)+(?!results/|tables/|[\w]+\.md)([\w./-]+)(?:#[\w-]*)?\)")


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Add README.md as the page index.md, with its links seen from docs/."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    text = text.replace("](docs/", "](").replace("[CONTRIBUTING.md](CONTRIBUTING.md)", "`CONTRIBUTING.md`")
    files.append(File.generated(config, "index.md", content=text.replace("[Apache-2.0](LICENSE)", "Apache-2.0")))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace links that leave docs/ by their text and path: the site has no copy of the source files."""
    return OUTSIDE.sub(lambda found: f"{found[1]} (`{found[2]}`)" if found[2] not in found[1] else found[1], markdown)


def on_nav(nav: Navigation, config: Any, **_: Any) -> None:
    """Store the navigation, which MkDocs does not pass to ``on_env``."""
    config.extra["navigation"] = nav


def on_env(_env: Any, config: Any, files: Files, **_: Any) -> None:
    """Add llms.txt, an index for language models: each page of the navigation with its first sentence."""
    lines = [f"# {config.site_name}", "", f"> {config.site_description}"]
    for section in config.extra["navigation"].items:
        lines += ["", f"## {section.title}", ""]
        for page in section.children or [section]:
            lines.append(f"- [{page.title}]({page.file.dest_uri}): {first_sentence(page.markdown)}")
    files.append(File.generated(config, "llms.txt", content="\n".join([*lines, ""])))


def first_sentence(markdown: str) -> str:
    """Return the first sentence of a page's text, without links."""
    text = re.sub(r"<!--.*?-->|^```.*?^```|^#.*?$|^!\[.*?$|^\|.*?$", "", markdown, flags=re.DOTALL | re.MULTILINE)
    paragraph = " ".join(text.strip().partition("\n\n")[0].split())
    plain = re.sub(r"\[([^\]]+)\]\([^)]+\)", r"\1", paragraph)
    return re.split(r"(?<=[.:])\s", plain)[0].rstrip(":")
