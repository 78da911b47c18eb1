"""``wheelleg inspect RUN|FILE``: show the contents of a recording, and answer questions about it.

``wheelleg inspect LOG --against RUN`` compares a robot's log with the policy and the simulation of a run. Without an
action such as ``--plot``, the command prints a summary. Several actions run in the order of ``ACTIONS``.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.arguments import UsageError, add_json, add_root, offer, print_json
from wheelleg_exp.cli.printing.terminal import styled
from wheelleg_exp.errors import EXIT_FINDING, EXIT_OK, RunDirectoryError

if TYPE_CHECKING:
    from wheelleg_exp.inspection.recording_target import Target
    from wheelleg_exp.inspection.row_selection import Selection
    from wheelleg_exp.recording.reading.recording_reader import Recording


@dataclass(frozen=True)
class Inspected:
    """The recording that the command line names, and the selected rows of this recording."""

    target: Target
    selection: Selection
    recording_id: str | None = None

    @cached_property
    def recording(self) -> Recording:
        """The opened recording; the first access to this property opens the recording file."""
        from wheelleg_exp.recording.reading.recording_reader import Recording

        return Recording(self.target.path, recording_id=self.recording_id)


@dataclass(frozen=True)
class Result:
    """The result of an action: its JSON document, a function that prints the result as text, and its exit status."""

    document: Any
    show: Callable[[], None]
    status: int = EXIT_OK
    notes: tuple[str, ...] = ()  # Notes for the user are printed on standard error.


@dataclass(frozen=True)
class Action:
    """One action of ``wheelleg inspect``: the name of its option in ``args``, and the other options that it reads."""

    name: str
    run: Callable[[argparse.Namespace, Inspected], Result]
    options: tuple[str, ...] = ()


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    text = "a run directory, its id, 'latest', or a recording; with --against a robot's log (.csv, .parquet, .mcap)"
    parser.add_argument("recording", metavar="RUN|FILE", help=text)
    text = "compare a robot's log with the policy and the simulation of this run; exit status 1 if they differ"
    offer("run", parser.add_argument("--against", metavar="RUN", help=text))
    parser.add_argument("--play", action="store_true", help="use the newest play of the run instead of its training")
    parser.add_argument("--id", metavar="ID", help="the id of the recording, if the file contains several")
    add_root(parser)
    group = parser.add_argument_group("selection of rows and columns")
    group.add_argument("--env", type=int, metavar="N", help="use only the rows of this environment")
    group.add_argument("--iteration", metavar="N|A-B", help="use only these training iterations")
    text = "use rows from this simulated time (2.5s) or step (150steps)"
    group.add_argument("--from", dest="begin", metavar="TIME", help=text)
    group.add_argument("--to", dest="end", metavar="TIME", help="use rows up to this simulated time or step")
    text = "a recorded number, such as rewards.base_height (repeatable)"
    group.add_argument("--term", action="append", default=[], metavar="NAME", help=text)
    group.add_argument("-o", "--output", type=Path, metavar="PATH", help="the file or folder to write")
    add = parser.add_argument
    add("--repair", action="store_true", help="write a repaired copy of a truncated recording")
    add("--summary", action="store_true", help="print the summary in addition to other output")
    add("--names", action="store_true", help="print the names of all recorded numbers")
    add("--stats", action="store_true", help="print the statistics of each --term")
    text = "print the times at which a condition is true: 'terminations.base_contact', 'base.pitch > 0.3'"
    add("--where", metavar="CONDITION", help=text)
    add("--around", metavar="LENGTH", help="with --where: print also the rows around each time: 0.5s, 200ms, 30steps")
    add("--limit", type=_count, metavar="N", help="the most lines to print (default: 10)")
    add("--compare", metavar="RUN|FILE", help="another recording; exit status 1 if they differ")
    text = "draw curves into a .png, .svg or .pdf: each --term, otherwise a default page; "
    text += "with --compare both recordings"
    add("--plot", type=Path, metavar="FILE", help=text)
    add("--export", metavar="KIND", help="write the numbers as parquet or csv: -o FOLDER, with --term -o FILE")
    add("--screenshot", type=Path, metavar="FILE", help="draw the robot into a .png, .jpg or .webp")
    add("--at", metavar="WHEN", help="a simulated time (1.5s) or step (90steps), or a term: when it is first not zero")
    add("--viewer", action="store_true", help="draw rerun's whole viewer instead of the robot alone")
    add("--width", type=int, metavar="PX", help="width of a picture or video")
    add("--height", type=int, metavar="PX", help="height of a picture or video")
    add("--video", type=Path, metavar="FILE", help="draw the robot's motion into an .mp4, .mkv or .mov")
    add("--fps", type=float, metavar="N", help="pictures per second (default: 30)")
    add("--speed", type=float, metavar="X", help="the speed of the motion; 0.25 is slow motion (default: 1)")
    add("--open", action="store_true", help="open rerun's viewer in a window")
    add("--web", action="store_true", help="serve rerun's viewer for a browser on this machine")
    add("--port", type=int, metavar="N", help="port of --web (default: a free one)")
    add("--no-browser", action="store_true", help="with --web: do not open a browser")
    add_json(parser)


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a valid number of lines; expected 0 or more")
    return int(text)


def run(args: argparse.Namespace) -> int:
    """Run each action that an option such as ``--plot`` requests, and return the highest exit status of the actions."""
    from wheelleg_exp.inspection.recording_target import find_target
    from wheelleg_exp.inspection.row_selection import Selection, parse_iterations, parse_length, require_order

    if args.against is not None:
        return _against(args)
    default = "stats" if args.term else "summary"
    chosen = [action for action in ACTIONS if _is_given(args, action.name)]
    chosen = chosen or [action for action in ACTIONS if action.name == default]
    # Raise UsageError for a command-line option that no requested inspection action reads.
    used = {option for action in chosen for option in action.options}
    for option in dict.fromkeys(option for action in ACTIONS for option in action.options):
        if option not in used and _is_given(args, option):
            word = {"begin": "--from", "end": "--to"}.get(option, "--" + option.replace("_", "-"))
            users = [f"--{action.name}" for action in ACTIONS if option in action.options]
            message = "the option has no effect on the chosen actions"
            raise UsageError(message, key=word, expected="also " + " or ".join(users))
    target = find_target(args.recording, args.root, play=args.play)
    selection = Selection(
        env_id=args.env,
        iterations=None if args.iteration is None else parse_iterations(args.iteration),
        begin=None if args.begin is None else parse_length(args.begin, "--from"),
        end=None if args.end is None else parse_length(args.end, "--to"),
    )
    require_order(selection)
    inspected = Inspected(target, selection, args.id)
    results = {}
    for action in chosen:
        results[action.name] = result = action.run(args, inspected)
        for note in result.notes:
            print(note, file=sys.stderr)
        if not args.json:
            result.show()
    if args.json:
        print_json({"recording": str(target.path), **{name: result.document for name, result in results.items()}})
    return max(result.status for result in results.values())


def _against(args: argparse.Namespace) -> int:
    for option in ("play", "id", *(a.name for a in ACTIONS), *(option for a in ACTIONS for option in a.options)):
        if option != "plot" and _is_given(args, option):
            word = {"begin": "--from", "end": "--to"}.get(option, "--" + option.replace("_", "-"))
            raise UsageError("the option has no effect on a robot's log", key=word, expected="--plot or --json")

    from wheelleg_exp.robot_logs.log_comparison import compare_with_run
    from wheelleg_exp.run.run_directory import RunDirectory

    report = compare_with_run(Path(args.recording), RunDirectory.open(args.against, args.root))
    if args.plot is not None:
        from wheelleg_exp.inspection.recording_plots import log_figure, save

        save(log_figure(report), args.plot)
    if args.json:
        print_json({"log": args.recording, **report.document()})
    else:
        from wheelleg_exp.cli.printing.terminal import hanging

        print(f"{report.rows} rows, {report.windows} simulated windows of 0.1 s")
        for finding in report.findings:
            print(hanging(f"{finding.kind}: {finding.wrong}", 2))
            print(hanging(finding.evidence, 4, "  "))
            print(hanging(f"to do: {finding.change}", 4, "  "))
        for question in report.undecided:
            print(hanging(f"cannot tell {question}", 2))
        print(f"{len(report.findings)} finding{'' if len(report.findings) == 1 else 's'}")
    return EXIT_FINDING if report.findings else EXIT_OK


def _is_given(args: argparse.Namespace, option: str) -> bool:
    return getattr(args, option) not in (None, False, [])


def _other_recording(args: argparse.Namespace) -> Recording:
    """Open the recording given in ``--compare``; with ``--play``, open the run's last ``wheelleg play`` recording."""
    from wheelleg_exp.inspection.recording_target import find_target, names_a_run
    from wheelleg_exp.recording.reading.recording_reader import Recording

    path = find_target(args.compare, args.root, play=args.play and names_a_run(args.compare)).path
    try:
        return Recording(path)
    except RunDirectoryError:
        if args.id is None:
            raise
        return Recording(path, recording_id=args.id)


def _summary(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_summary
    from wheelleg_exp.inspection.recording_summary import summarize

    summary = summarize(inspected.recording, inspected.selection)
    others, status = inspected.target.others(), inspected.target.status
    document = {**summary.as_dict(), "run_status": status, "other_recordings": [str(path) for path in others]}
    return Result(document, lambda: print_summary(summary, others, inspected.selection, status))


def _statistics(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_statistics
    from wheelleg_exp.inspection.recorded_numbers import term_statistics, units

    if not args.term:
        expected = "also --term NAME, such as rewards.base_height"
        raise UsageError("the name of a recorded number is missing", key="--stats", expected=expected)
    found = term_statistics(inspected.recording, args.term, inspected.selection)
    words = units(inspected.recording, found, inspected.selection.env_id)
    document = {name: {**asdict(value), "unit": words.get(name)} for name, value in found.items()}
    return Result(document, lambda: print_statistics(found, words))


def _where(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_hits
    from wheelleg_exp.inspection.condition_query import Condition, find_hits
    from wheelleg_exp.inspection.recorded_numbers import units
    from wheelleg_exp.inspection.row_selection import parse_length

    condition = Condition(args.where)
    around = None if args.around is None else parse_length(args.around, "--around")
    hits = find_hits(inspected.recording, condition, columns=args.term, around=around, selection=inspected.selection)
    found = []
    for hit in hits:
        rows = {} if hit.around is None else {"rows": hit.around.table.to_pydict()}
        found.append({"first": asdict(hit.first), "last": asdict(hit.last), "frames": hit.frames, **rows})
    words = units(inspected.recording, args.term or condition.names, inspected.selection.env_id)
    document = {"condition": condition.text, "count": len(hits), "hits": found}
    return Result(document, lambda: print_hits(hits, _limit(args), words))


def _compare(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_comparison
    from wheelleg_exp.inspection.compare_recordings import compare

    other = _other_recording(args)
    found = compare(inspected.recording, other)
    return Result(
        {"other": str(other.path), **found.as_dict()},
        lambda: print_comparison(found, inspected.recording, other, _limit(args)),
        EXIT_OK if found.is_equal else EXIT_FINDING,
        () if inspected.selection.is_all else ("note: --compare compares the whole recordings",),
    )


def _limit(args: argparse.Namespace) -> int:
    return 10 if args.limit is None else args.limit


def _repair(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.inspection_tables import print_repaired
    from wheelleg_exp.recording.reading.recording_repair import repair

    with inspected.target.resting():
        done = repair(inspected.target.path, args.output)
    return Result({**asdict(done), "health": done.health.as_dict()}, lambda: print_repaired(done))


def _names(_args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.cli.printing.terminal import print_table

    recording = inspected.recording
    numbers = recording.all_numbers(inspected.selection.env_id)
    rows = [(name, recording.count(number.entity)) for name, number in numbers.items()]
    table = [(name, str(count)) for name, count in rows]
    document = [{"name": name, "rows": count} for name, count in rows]
    return Result(document, lambda: print_table(("number", "rows"), table))


def _plot(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection import recording_plots
    from wheelleg_exp.inspection.plot_data import Source

    recording_plots.require_path(args.plot)
    recording, chosen = inspected.recording, inspected.selection
    if args.compare is not None:
        other = _other_recording(args)
        paths = [path.resolve() for path in (inspected.target.path, other.path)]
        names = [path.stem if path.stem != "recording" else path.parent.name for path in paths]
        if names[0] == names[1]:
            names = [f"{name} ({i})" for i, name in enumerate(names, start=1)]
        figure = recording_plots.overlay({names[0]: recording, names[1]: other}, args.term, selection=chosen)
    elif args.term:
        figure = recording_plots.terms_figure(recording, args.term, selection=chosen)
    else:
        figure = recording_plots.default_page(recording, selection=chosen)
    recording_plots.save(figure, args.plot)
    source = Source(recording, selection=chosen)
    return _written(args.plot, {"env": source.env_id}, f" ({source.whose})" if source.whose else "")


def _export(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.export_numbers import export

    if args.output is None:
        expected = "also -o FILE with --term, otherwise -o FOLDER"
        raise UsageError("the path of the exported file is missing", key="--export", expected=expected)
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
        viewer_screenshot(inspected.target.path, args.screenshot, time_s=time_s, width=width, height=height)
    else:
        recording_pictures.save(shown, row, args.screenshot, *_size(args, 1280, 720))
    facts: dict[str, object] = {"time_s": time_s, "step": int(shown.motion.step[row])}
    facts |= {"iteration": shown.motion.iteration_at(row), "env": shown.source.env_id}
    return _written(args.screenshot, facts, f" ({_environment(shown.env_id)}t = {time_s:.3f} s)")


def _size(args: argparse.Namespace, width: int, height: int) -> tuple[int, int]:
    return width if args.width is None else args.width, height if args.height is None else args.height


def _environment(env_id: int | None) -> str:
    return "" if env_id is None else f"environment {env_id}, "


def _video(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.recording_video import video

    def progress(done: int, total: int) -> None:
        styled(sys.stderr).write(f"\r{done} of {total} pictures" + ("\n" if done == total else ""))
        sys.stderr.flush()

    width, height = _size(args, 960, 540)
    done = video(
        inspected.recording,
        args.video,
        selection=inspected.selection,
        fps=30.0 if args.fps is None else args.fps,
        speed=1.0 if args.speed is None else args.speed,
        width=width,
        height=height,
        progress=progress if sys.stderr.isatty() else None,
    )
    facts: dict[str, object] = {"frames": done.frames, "fps": done.fps, "duration_s": done.duration}
    facts["codec"] = done.codec
    facts["env"] = inspected.recording.env_ids[0] if inspected.selection.env_id is None else inspected.selection.env_id
    text = f" ({_environment(done.env_id)}{done.frames} pictures, {done.duration:.1f} s, {done.codec})"
    return _written(args.video, facts, text)


def _open(_: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.rerun_viewer import open_window

    # The property ``recording`` reads the file, so that a damaged file raises an error before Rerun's viewer opens it.
    with suppress(KeyboardInterrupt):  # Ctrl-C closes the window of the Rerun viewer.
        open_window(inspected.recording.path)
    return Result({"closed": True}, lambda: None)


def _web(args: argparse.Namespace, inspected: Inspected) -> Result:
    from wheelleg_exp.inspection.rerun_viewer import serve

    def say(line: str) -> None:
        print(line, file=sys.stderr if args.json else sys.stdout, flush=True)

    with suppress(KeyboardInterrupt):
        serve(inspected.recording.path, say, port=args.port or 0, browser=not args.no_browser)
    return Result({"closed": True}, lambda: None)


def _written(path: Path, facts: dict[str, object], text: str = "") -> Result:
    return Result({"path": str(path), **facts}, lambda: print(f"wrote {path}{text}"))


_ROWS = ("env", "iteration", "begin", "end")  # Names of the command-line options that select rows of a recording.
# The action 'web' runs last, because the web server runs until the user stops the command.
ACTIONS = (
    Action("repair", _repair, ("output",)),
    Action("summary", _summary, _ROWS),
    Action("names", _names, ("env",)),
    Action("stats", _statistics, (*_ROWS, "term")),
    Action("where", _where, (*_ROWS, "term", "around", "limit")),
    Action("compare", _compare, ("limit",)),
    Action("plot", _plot, (*_ROWS, "term")),
    Action("export", _export, (*_ROWS, "term", "output")),
    Action("screenshot", _screenshot, ("env", "iteration", "at", "viewer", "width", "height")),
    Action("video", _video, (*_ROWS, "fps", "speed", "width", "height")),
    Action("open", _open),
    Action("web", _web, ("port", "no_browser")),
)
