"""The actions of ``wheelleg inspect`` that make files, pictures and windows."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.common import UsageError
from wheelleg_exp.cli.inspecting.action import ROWS, Action, Inspected, Result, other_recording
from wheelleg_exp.cli.printing.streams import styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _plot(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.plots import plots
    from wheelleg_exp.inspection.plots.plot_data import Source

    plots.require_path(args.plot)
    plots.save(_figure(args, inspected), args.plot)
    source = Source(inspected.recording, selection=inspected.selection)
    return _written(args.plot, {"env": source.env_id}, f" ({source.whose})" if source.whose else "")


def _figure(args: argparse.Namespace, inspected: Inspected) -> Figure:
    from wheelleg_exp.inspection.plots import plots

    chosen = inspected.selection
    if args.compare is None:
        if args.term:
            return plots.terms_figure(inspected.recording, args.term, selection=chosen)
        return plots.default_page(inspected.recording, selection=chosen)
    recordings = _with_other(args, inspected)
    return plots.overlay(recordings, args.term, selection=chosen)


def _with_other(args: argparse.Namespace, inspected: Inspected) -> dict[str, Any]:
    other = other_recording(args)
    return _labelled([(inspected.path, inspected.recording), (other.path, other)])


def _labelled(pairs: list[tuple[Path, Any]]) -> dict[str, Any]:
    """Return recordings by a short name that tells them apart."""
    first, second = (path.resolve() for path, _ in pairs)
    names = [path.stem if path.stem != "recording" else path.parent.name for path in (first, second)]
    if names[0] == names[1]:
        names = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
    return {name: recording for name, (_, recording) in zip(names, pairs, strict=True)}


def _export(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.questions.export import export

    if args.output is None:
        expected = "-o FILE with --term, else -o FOLDER"
        raise UsageError("it is not said where to", key="--export", expected=expected)
    found = export(inspected.recording, args.export, args.output, terms=args.term, selection=inspected.selection)
    files = [{"path": str(e.path), "group": e.group, "rows": e.rows, "columns": e.columns} for e in found]

    def show() -> None:
        for entry in found:
            print(f"wrote {entry.path}  {entry.rows} rows, {entry.columns} columns")

    return Result({"path": str(args.output), "files": files}, show)


def _screenshot(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.pictures import pictures

    iterations = inspected.selection.iterations
    iteration = None if iterations is None else iterations[0]
    shown = pictures.scenery(inspected.recording, inspected.selection.env_id, args.at, iteration)
    row = pictures.row_at(shown, at=args.at, iteration=iteration)
    time_s = float(shown.motion.time[row])
    if args.viewer:
        from wheelleg_exp.inspection.viewer.viewer import viewer_screenshot

        width, height = _size(args, 1600, 900)
        viewer_screenshot(inspected.path, args.screenshot, time_s=time_s, width=width, height=height)
    else:
        pictures.save(shown, row, args.screenshot, *_size(args, 1280, 720))
    told = {
        "time_s": time_s,
        "step": int(shown.motion.step[row]),
        "iteration": shown.motion.iteration_at(row),
        "env": shown.source.env_id,
    }
    return _written(args.screenshot, told, f" ({_whose(shown.env_id)}t = {time_s:.3f} s)")


def _size(args: argparse.Namespace, width: int, height: int) -> tuple[int, int]:
    return width if args.width is None else args.width, height if args.height is None else args.height


def _whose(env_id: int | None) -> str:
    """Return of which of several recorded environments something is."""
    return "" if env_id is None else f"environment {env_id}, "


def _video(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.pictures.video import video

    width, height = _size(args, 960, 540)
    done = video(
        inspected.recording,
        args.video,
        selection=inspected.selection,
        fps=30.0 if args.fps is None else args.fps,
        speed=1.0 if args.speed is None else args.speed,
        width=width,
        height=height,
        progress=_progress(),
    )
    told: dict[str, Any] = {"frames": done.frames, "fps": done.fps, "duration_s": done.duration, "codec": done.codec}
    told["env"] = inspected.recording.env_ids[0] if inspected.selection.env_id is None else inspected.selection.env_id
    words = f" ({_whose(done.env_id)}{done.frames} pictures, {done.duration:.1f} s, {done.codec})"
    return _written(args.video, told, words)


def _progress() -> Callable[[int, int], None] | None:
    """Return what tells of the pictures so far, where someone looks."""
    if not sys.stderr.isatty():
        return None

    def tell(done: int, total: int) -> None:
        styled(sys.stderr).write(f"\r{done} of {total} pictures" + ("\n" if done == total else ""))
        sys.stderr.flush()

    return tell


def _open(_: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.viewer.viewer import open_window

    with suppress(KeyboardInterrupt):  # the way to end it from here
        open_window(_readable(inspected))
    return Result({"closed": True}, lambda: None)


def _web(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.viewer.viewer import serve

    def say(line: str) -> None:
        print(line, file=sys.stderr if args.json else sys.stdout, flush=True)

    with suppress(KeyboardInterrupt):  # the only way to end it
        serve(_readable(inspected), say, port=args.port or 0, browser=not args.no_browser)
    return Result({"closed": True}, lambda: None)


def _readable(inspected: Inspected) -> Path:
    """Return the recording's path, after reading it: the viewer tells less well of what is wrong with a file."""
    return Path(inspected.recording.path)


def _written(path: Path, told: dict[str, Any], words: str = "") -> Result:
    return Result({"path": str(path), **told}, lambda: print(f"wrote {path}{words}"))


def _add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw curves into a .png, .svg or .pdf: of each --term, else what matters; with --compare both recordings",
    )


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--export", metavar="KIND", help="write the numbers as parquet or csv: -o FOLDER, with --term -o FILE"
    )


def _add_screenshot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--screenshot", type=Path, metavar="FILE", help="draw the robot into a .png, .jpg or .webp")
    parser.add_argument(
        "--at", metavar="WHEN", help="at a simulated time (1.5s) or step (90steps), or when a term is first not zero"
    )
    parser.add_argument("--viewer", action="store_true", help="draw rerun's whole viewer instead of the robot alone")
    parser.add_argument("--width", type=int, metavar="PX", help="of a picture or video")
    parser.add_argument("--height", type=int, metavar="PX", help="of a picture or video")


def _add_video(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--video", type=Path, metavar="FILE", help="draw the robot's motion into an .mp4, .mkv or .mov")
    parser.add_argument("--fps", type=float, metavar="N", help="pictures a second (default: 30)")
    parser.add_argument("--speed", type=float, metavar="X", help="0.25 is slow motion (default: 1)")


def _add_open(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--open", action="store_true", help="open rerun's viewer in a window")


def _add_web(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--web", action="store_true", help="serve rerun's viewer for a browser on this machine")
    parser.add_argument("--port", type=int, metavar="N", help="of --web (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="with --web: open no browser")


ACTIONS: tuple[Action, ...] = (
    Action("plot", _add_plot, _plot, (*ROWS, "term")),
    Action("export", _add_export, _export, (*ROWS, "term", "output")),
    Action("screenshot", _add_screenshot, _screenshot, ("env", "iteration", "at", "viewer", "width", "height")),
    Action("video", _add_video, _video, (*ROWS, "fps", "speed", "width", "height")),
    Action("open", _add_open, _open),
    Action("web", _add_web, _web, ("port", "no_browser")),
)
