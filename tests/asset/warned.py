"""Warnings of small test robots, most of which have no colliders."""

from wheelleg_exp.asset import Conversion
from wheelleg_exp.asset.report_writer import FALLS


def warned(conversion: Conversion) -> tuple[str, ...]:
    return tuple(text for text in conversion.report.warnings if text != FALLS)
