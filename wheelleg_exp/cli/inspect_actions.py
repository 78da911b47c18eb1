"""The actions of ``wheelleg inspect``: summary, statistics, moments, comparison, repair, and files and windows."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.arguments import UsageError
from wheelleg_exp.cli.printing.terminal import styled
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK, RunDirectoryError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from wheelleg_exp.inspection.recording_target import Target
    from wheelleg_exp.inspection.row_selection import Selection
    from wheelleg_exp.recording.reading.recording_reader import Recording


ROWS = ("env", "iteration", "begin", "end")  # the options that select rows


@dataclass(frozen=True)
class Inspected:
    """The recording and the rows that the command line selects.

    Attributes:
        target: the recording's file and its run.
        selection: the selected rows (``--env``, ``--iteration``, ``--from``, ``--to``).
        recording_id: the id of the recording, if the file contains several.
    """

    target: Target
    selection: Selection
    recording_id: str | None = None

    @property
    def path(self) -> Path:
        """The recording's file."""
        return self.target.path

    @cached_property
    def recording(self) -> Recording:
        """The recording, opened on first use."""
        from wheelleg_exp.recording.reading.recording_reader import Recording

        return Recording(self.path, recording_id=self.recording_id)


@dataclass(frozen=True)
class Result:
    """The result of an action.

    Attributes:
        document: the JSON document of the action. ``--json`` prints it below the action's name.
        show: prints the result as text.
        status: the exit status of the action. The command returns the highest one.
        notes: lines for standard error.
    """

    document: Any
    show: Callable[[], None]
    status: int = EXIT_OK
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Action:
    """One action of ``wheelleg inspect``.

    Attributes:
        name: the name of its option in ``args``. The action runs if the option is neither None nor False.
        configure: adds the options of the action.
        run: runs the action.
        options: the other options that the action reads, by their names in ``args``.
    """

    name: str
    configure: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Inspected], Result]
    options: tuple[str, ...] = ()

    def is_chosen(self, args: argparse.Namespace) -> bool:
        """Return whether the command line selects the action."""
        return getattr(args, self.name) not in (None, False)


# The options with another name in ``args``.
_OPTION_NAMES = {"begin": "--from", "end": "--to"}


def require_used(args: argparse.Namespace, chosen: Sequence[Action], actions: Sequence[Action]) -> None:
    """Raise UsageError if none of the chosen actions reads a given option."""
    used = {option for action in chosen for option in action.options}
    for option in dict.fromkeys(option for action in actions for option in action.options):
        if option not in used and getattr(args, option) not in (None, False, []):
            word = _OPTION_NAMES.get(option, "--" + option.replace("_", "-"))
            users = [f"--{action.name}" for action in actions if option in action.options]
            raise UsageError("the option has no effect here", key=word, expected="also " + " or ".join(users))


def other_recording(args: argparse.Namespace) -> Recording:
    """Return the recording of ``--compare``. ``--play`` and ``--id`` also apply to it, if it has a play or that id."""
    from wheelleg_exp.inspection.recording_target import find_target, names_a_run
    from wheelleg_exp.recording.reading.recording_reader import Recording

    path = find_target(args.compare, args.root, play=args.play and names_a_run(args.compare)).path
    try:
        return Recording(path)
    except RunDirectoryError:
        if args.id is None:
            raise
        return Recording(path, recording_id=args.id)


_LIMIT = 10  # lines that are printed


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Add the options that select rows and columns."""
    group = parser.add_argument_group("selection of rows and columns")
    group.add_argument("--env", type=int, metavar="N", help="one of the recorded environments")
    group.add_argument("--iteration", metavar="N|A-B", help="training iterations")
    group.add_argument(
        "--from", dest="begin", metavar="TIME", help="from this simulated time (2.5s) or step (150steps)"
    )
    group.add_argument("--to", dest="end", metavar="TIME", help="up to this simulated time or step")
    group.add_argument(
        "--term", action="append", default=[], metavar="NAME", help="a number, such as rewards.base_height (repeatable)"
    )
    group.add_argument("-o", "--output", type=Path, metavar="PATH", help="the file or folder to write")


def selection_of(args: argparse.Namespace) -> Selection:
    """Return the rows that the options select; raise WheellegError if an option is wrong."""
    from wheelleg_exp.inspection.row_selection import Selection, parse_iterations, parse_length, require_order

    chosen = Selection(
        env_id=args.env,
        iterations=None if args.iteration is None else parse_iterations(args.iteration),
        begin=None if args.begin is None else parse_length(args.begin, "--from"),
        end=None if args.end is None else parse_length(args.end, "--to"),
    )
    require_order(chosen)
    return chosen


def _summary(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_summary
    from wheelleg_exp.inspection.recording_summary import summarize

    summary = summarize(inspected.recording, inspected.selection)
    others = inspected.target.others()
    status = inspected.target.status
    document = {**summary.as_dict(), "run_status": status, "other_recordings": [str(path) for path in others]}
    return Result(document, lambda: print_summary(summary, others, inspected.selection, status))


def _statistics(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_statistics
    from wheelleg_exp.inspection.recorded_numbers import term_statistics, units

    if not args.term:
        raise UsageError("names no number", key="--stats", expected="also --term NAME, such as rewards.base_height")
    found = term_statistics(inspected.recording, args.term, inspected.selection)
    words = units(inspected.recording, found, inspected.selection.env_id)
    document = {name: {**value.as_dict(), "unit": words.get(name)} for name, value in found.items()}
    return Result(document, lambda: print_statistics(found, words))


def _where(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_hits
    from wheelleg_exp.inspection.condition_query import Condition, find_hits
    from wheelleg_exp.inspection.recorded_numbers import units
    from wheelleg_exp.inspection.row_selection import parse_length

    condition = Condition(args.where)
    around = None if args.around is None else parse_length(args.around, "--around")
    hits = find_hits(inspected.recording, condition, columns=args.term, around=around, selection=inspected.selection)
    document = {"condition": condition.text, "count": len(hits), "hits": [_hit(hit) for hit in hits]}
    words = units(inspected.recording, args.term or condition.names, inspected.selection.env_id)
    return Result(document, lambda: print_hits(hits, _limit(args), words))


def _hit(hit: Any) -> dict[str, Any]:
    found = {"first": asdict(hit.first), "last": asdict(hit.last), "frames": hit.frames}
    return found if hit.around is None else {**found, "rows": hit.around.table.to_pydict()}


def _compare(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_comparison
    from wheelleg_exp.inspection.compare_recordings import compare

    other = other_recording(args)
    found = compare(inspected.recording, other)
    document = {"other": str(other.path), **found.as_dict()}
    return Result(
        document,
        lambda: print_comparison(found, inspected.recording, other, _limit(args)),
        EXIT_OK if found.is_equal else EXIT_FINDING,
        () if inspected.selection.is_all else ("note: --compare compares the whole recordings",),
    )


def _limit(args: argparse.Namespace) -> int:
    return _LIMIT if args.limit is None else args.limit


def _repair(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_repaired
    from wheelleg_exp.recording.reading.recording_repair import repair

    with inspected.target.resting():
        done = repair(inspected.path, args.output)
    document = {**asdict(done), "health": done.health.as_dict()}
    return Result(document, lambda: print_repaired(done))


def _list(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_names
    from wheelleg_exp.inspection.recorded_numbers import number_list

    found = number_list(inspected.recording, inspected.selection.env_id)
    return Result([asdict(entry) for entry in found], lambda: print_names(found))


def _flag(name: str, text: str) -> Any:
    return lambda parser: parser.add_argument(name, action="store_true", help=text)


def _add_where(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--where",
        metavar="CONDITION",
        help="print the times at which a condition is true: 'terminations.base_contact', 'base.pitch > 0.3'",
    )
    parser.add_argument("--around", metavar="LENGTH", help="with --where: and the rows around it: 0.5s, 200ms, 30steps")
    parser.add_argument("--limit", type=_count, metavar="N", help="the most lines to print (default: 10)")


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of lines; expected 0 or more")
    return int(text)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--compare", metavar="RUN|FILE", help="another recording; exit status 1 if they differ")


SUMMARY = Action("summary", _flag("--summary", "print the summary in addition to other output"), _summary, ROWS)
STATISTICS = Action("stats", _flag("--stats", "print the statistics of each --term"), _statistics, (*ROWS, "term"))
READING_ACTIONS: tuple[Action, ...] = (
    Action("repair", _flag("--repair", "write a repaired copy of a truncated recording"), _repair, ("output",)),
    SUMMARY,
    Action("names", _flag("--names", "print the names of all recorded numbers"), _list, ("env",)),
    STATISTICS,
    Action("where", _add_where, _where, (*ROWS, "term", "around", "limit")),
    Action("compare", _add_compare, _compare, ("limit",)),
)


def _plot(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection import recording_plots
    from wheelleg_exp.inspection.plot_data import Source

    recording_plots.require_path(args.plot)
    recording_plots.save(_figure(args, inspected), args.plot)
    source = Source(inspected.recording, selection=inspected.selection)
    return _written(args.plot, {"env": source.env_id}, f" ({source.whose})" if source.whose else "")


def _figure(args: argparse.Namespace, inspected: Inspected) -> Figure:
    from wheelleg_exp.inspection import recording_plots

    chosen = inspected.selection
    if args.compare is None:
        if args.term:
            return recording_plots.terms_figure(inspected.recording, args.term, selection=chosen)
        return recording_plots.default_page(inspected.recording, selection=chosen)
    other = other_recording(args)
    recordings = _labelled([(inspected.path, inspected.recording), (other.path, other)])
    return recording_plots.overlay(recordings, args.term, selection=chosen)


def _labelled(pairs: list[tuple[Path, Any]]) -> dict[str, Any]:
    """Return two recordings by short and different names."""
    first, second = (path.resolve() for path, _ in pairs)
    names = [path.stem if path.stem != "recording" else path.parent.name for path in (first, second)]
    if names[0] == names[1]:
        names = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
    return {name: recording for name, (_, recording) in zip(names, pairs, strict=True)}


def _export(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.export_numbers import export

    if args.output is None:
        expected = "also -o FILE with --term, otherwise -o FOLDER"
        raise UsageError("names no output", key="--export", expected=expected)
    found = export(inspected.recording, args.export, args.output, terms=args.term, selection=inspected.selection)
    files = [{"path": str(e.path), "group": e.group, "rows": e.rows, "columns": e.columns} for e in found]

    def show() -> None:
        for entry in found:
            print(f"wrote {entry.path}  {entry.rows} rows, {entry.columns} columns")

    return Result({"path": str(args.output), "files": files}, show)


def _screenshot(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection import recording_pictures

    iterations = inspected.selection.iterations
    iteration = None if iterations is None else iterations[0]
    shown = recording_pictures.scenery(inspected.recording, inspected.selection.env_id, args.at, iteration)
    row = recording_pictures.row_at(shown, at=args.at, iteration=iteration)
    time_s = float(shown.motion.time[row])
    if args.viewer:
        from wheelleg_exp.inspection.rerun_viewer import viewer_screenshot

        width, height = _size(args, 1600, 900)
        viewer_screenshot(inspected.path, args.screenshot, time_s=time_s, width=width, height=height)
    else:
        recording_pictures.save(shown, row, args.screenshot, *_size(args, 1280, 720))
    facts = {
        "time_s": time_s,
        "step": int(shown.motion.step[row]),
        "iteration": shown.motion.iteration_at(row),
        "env": shown.source.env_id,
    }
    return _written(args.screenshot, facts, f" ({_environment(shown.env_id)}t = {time_s:.3f} s)")


def _size(args: argparse.Namespace, width: int, height: int) -> tuple[int, int]:
    return width if args.width is None else args.width, height if args.height is None else args.height


def _environment(env_id: int | None) -> str:
    return "" if env_id is None else f"environment {env_id}, "


def _video(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.recording_video import video

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
    facts: dict[str, Any] = {"frames": done.frames, "fps": done.fps, "duration_s": done.duration, "codec": done.codec}
    facts["env"] = inspected.recording.env_ids[0] if inspected.selection.env_id is None else inspected.selection.env_id
    text = f" ({_environment(done.env_id)}{done.frames} pictures, {done.duration:.1f} s, {done.codec})"
    return _written(args.video, facts, text)


def _progress() -> Callable[[int, int], None] | None:
    """Return a function that shows the number of finished pictures; None if standard error is not a terminal."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        styled(sys.stderr).write(f"\r{done} of {total} pictures" + ("\n" if done == total else ""))
        sys.stderr.flush()

    return show


def _open(_: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.rerun_viewer import open_window

    with suppress(KeyboardInterrupt):  # Ctrl-C closes the window
        open_window(_readable(inspected))
    return Result({"closed": True}, lambda: None)


def _web(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.rerun_viewer import serve

    def say(line: str) -> None:
        print(line, file=sys.stderr if args.json else sys.stdout, flush=True)

    with suppress(KeyboardInterrupt):  # Ctrl-C stops the server
        serve(_readable(inspected), say, port=args.port or 0, browser=not args.no_browser)
    return Result({"closed": True}, lambda: None)


def _readable(inspected: Inspected) -> Path:
    """Read the recording and return its path. Reading reports a damaged file better than the viewer does."""
    return Path(inspected.recording.path)


def _written(path: Path, facts: dict[str, Any], text: str = "") -> Result:
    return Result({"path": str(path), **facts}, lambda: print(f"wrote {path}{text}"))


def _add_plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--plot",
        type=Path,
        metavar="FILE",
        help="draw curves into a .png, .svg or .pdf: each --term, otherwise a default page; with --compare both "
        "recordings",
    )


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--export", metavar="KIND", help="write the numbers as parquet or csv: -o FOLDER, with --term -o FILE"
    )


def _add_screenshot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--screenshot", type=Path, metavar="FILE", help="draw the robot into a .png, .jpg or .webp")
    parser.add_argument(
        "--at", metavar="WHEN", help="a simulated time (1.5s) or step (90steps), or a term: when it is first not zero"
    )
    parser.add_argument("--viewer", action="store_true", help="draw rerun's whole viewer instead of the robot alone")
    parser.add_argument("--width", type=int, metavar="PX", help="width of a picture or video")
    parser.add_argument("--height", type=int, metavar="PX", help="height of a picture or video")


def _add_video(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--video", type=Path, metavar="FILE", help="draw the robot's motion into an .mp4, .mkv or .mov")
    parser.add_argument("--fps", type=float, metavar="N", help="pictures per second (default: 30)")
    parser.add_argument("--speed", type=float, metavar="X", help="0.25 is slow motion (default: 1)")


def _add_open(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--open", action="store_true", help="open rerun's viewer in a window")


def _add_web(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--web", action="store_true", help="serve rerun's viewer for a browser on this machine")
    parser.add_argument("--port", type=int, metavar="N", help="port of --web (default: a free one)")
    parser.add_argument("--no-browser", action="store_true", help="with --web: do not open a browser")


PICTURE_ACTIONS: tuple[Action, ...] = (
    Action("plot", _add_plot, _plot, (*ROWS, "term")),
    Action("export", _add_export, _export, (*ROWS, "term", "output")),
    Action("screenshot", _add_screenshot, _screenshot, ("env", "iteration", "at", "viewer", "width", "height")),
    Action("video", _add_video, _video, (*ROWS, "fps", "speed", "width", "height")),
    Action("open", _add_open, _open),
    Action("web", _add_web, _web, ("port", "no_browser")),
)
