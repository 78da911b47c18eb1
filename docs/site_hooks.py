"""MkDocs hooks: README.md becomes the first page, and links to source files outside docs/ become plain code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

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
