"""The numbers of a drive as the page shows them: commands beside what the robot does, height, bars of rewards."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from wheelleg_exp.jobs.drive.axes import Axis
from wheelleg_exp.jobs.drive.controls import Controls
from wheelleg_exp.jobs.drive.session import Status

_GOOD, _BAD, _PLAIN = "#2f9e44", "#e03131", "#1c7ed6"
_BOX = "font-size:0.82em;line-height:1.5;padding:0.2em 1em"
HELP = (
    f'<div style="{_BOX};opacity:0.75">W S or arrows: forwards, back. A D: turn. Q E: sideways. T G: height. '
    "Space: pause. R: reset. F: push. X: stop. M: slow motion. A gamepad drives with its sticks.</div>"
)


def state(status: Status, controls: Controls, step_dt: float) -> str:
    """Return time, commands and measures, and the height."""
    fallen = f'<b style="color:{_BAD}">fallen: {escape(status.fallen)}</b>' if status.fallen else ""
    word = "paused" if controls.paused else f"{controls.speed:g}x"
    lines = [
        f'<div id="drive-time"><b>{status.time_s:.2f} s</b> · {word} · {1.0 / step_dt:.0f} Hz · '
        f"falls {status.falls} {fallen}</div>"
    ]
    lines += [_axis(axis, status.commands[name], status.measured.get(name)) for name, axis in controls.axes.items()]
    lines.append(f'<div id="drive-height">height {1e3 * status.height_m:.1f} mm</div>')
    return f'<div style="{_BOX}">{"".join(lines)}</div>'


def bars(values: Mapping[str, float]) -> str:
    """Return a bar a term, to the right for what pays and to the left for what costs, as long as its share."""
    most = max((abs(value) for value in values.values()), default=0.0) or 1.0
    rows = []
    for name, value in values.items():
        width = 50.0 * abs(value) / most
        left = 50.0 if value >= 0.0 else 50.0 - width
        rows.append(
            f"<div>{escape(name)}<span style='float:right'>{value:+.3f}</span></div>"
            + _bar(left, width, _GOOD if value >= 0.0 else _BAD)
        )
    return f'<div id="drive-rewards" style="{_BOX}">{"".join(rows)}</div>'


def _axis(axis: Axis, commanded: float, measured: float | None) -> str:
    shown = "" if measured is None else f" · is {measured:+.3f}"
    width = axis.high - axis.low
    middle, end = (100.0 * (axis.bounded(v) - axis.low) / width for v in (axis.rest, commanded))
    name = escape(axis.name)
    text = f'<div data-axis="{name}" data-command="{commanded:.4f}">{name} {commanded:+.3f}{shown}</div>'
    return text + _bar(min(middle, end), abs(end - middle), _PLAIN)


def _bar(left: float, width: float, colour: str) -> str:
    return (
        '<div style="position:relative;height:5px;background:#8883;border-radius:3px">'
        f'<div style="position:absolute;left:{left:.1f}%;width:{width:.1f}%;height:5px;background:{colour};'
        'border-radius:3px"></div></div>'
    )
