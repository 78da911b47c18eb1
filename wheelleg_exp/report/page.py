"""The page's text: blocks through the templates, everything escaped, nothing fetched from anywhere."""

from __future__ import annotations

import unicodedata
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from wheelleg_exp.report.blocks import Page

# Tells a later report that a file is one, and of which run.
MARK = '<meta name="wheelleg-report" content="'


def render(page: Page) -> str:
    """Return the whole HTML file as text.

    Scripts cannot run in it whatever its values hold: templates escape them, and its own policy forbids scripts and
    everything that would be fetched.
    """
    environment = Environment(
        loader=PackageLoader("wheelleg_exp.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    environment.filters["drawn"] = Markup  # for SVG that `svg.clean` has passed, and for the style sheet alone
    style = environment.get_template("report.css").render()
    return environment.get_template("report.html").render(page=page, style=style, mark=MARK)


def _visible(value: Any) -> Any:
    """Show characters that would hide or turn the text around them, and those that HTML cannot hold."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "".join(_character(letter) for letter in value) if not value.isprintable() else value


def _character(letter: str) -> str:
    if letter.isprintable() or letter in "\n\t" or unicodedata.category(letter) in ("Zs", "Zl", "Zp"):
        return letter
    return f"\\x{ord(letter):02x}" if ord(letter) < 256 else f"\\u{ord(letter):04x}"
