"""Print the performance figures of simulated policies, and the metrics of one or several evaluations."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.cli.printing.terminal import hanging, print_table, shown, tool
from wheelleg_exp.definitions import CONTACTS, MOTION, percent, rollout_label
from wheelleg_exp.errors import WheellegError, nearest_name

if TYPE_CHECKING:
    from wheelleg_exp.evaluation.method_comparison import Difference
    from wheelleg_exp.jobs.compare_evaluations import Compared
    from wheelleg_exp.jobs.evaluate_policy import Evaluated
    from wheelleg_exp.jobs.rollout_figures import ContactFigures, MotionFigures, StandFigures

# Metrics such as the RMS pitch ignore the first seconds of each episode, in which the robot settles.
_SETTLED = ("height_rmse_m", "height_mean_m", "pitch_rms_deg", "pitch_mean_deg")

_MOTION: Mapping[str, Callable[[float], str]] = {
    "drift_m": lambda value: f"{1e3 * value:.1f} mm",
    "yaw_drift_deg": lambda value: f"{value:.2f} deg",
    "action_rate_per_s": lambda value: f"{value:.2f} /s",
    "power_net_w": lambda value: f"{value:.3f} W",
    "torque_rms_nm": lambda value: f"{value:.4f} N·m",
    "at_limit": percent,
    "sign_changes_per_s": lambda value: f"{value:.1f} /s",
}


def print_figures(figures: StandFigures, motion: MotionFigures | None = None) -> None:
    """Print performance metrics of simulated episodes, each with the number of steps or episodes behind the metric."""
    ended, settled = _counted(figures.ended, "ended episode"), _settled(figures)
    of = {"survival": ended, "mean_return": ended, **dict.fromkeys(_SETTLED, settled)}
    values = {
        "survival": "-" if figures.survival is None else percent(figures.survival),
        "height_rmse_m": _millimetres(figures.height_rmse_m),
        "height_mean_m": _millimetres(figures.height_mean_m),
        "pitch_rms_deg": _degrees(figures.pitch_rms_deg),
        "pitch_mean_deg": _degrees(figures.pitch_mean_deg),
        "mean_return": "-" if figures.mean_return is None else f"{figures.mean_return:.2f}",
    }
    rows = [
        (rollout_label("episodes", None), f"{figures.episodes}", "the first of each environment"),
        *(((rollout_label("unfinished", None), f"{figures.unfinished}", ""),) if figures.unfinished else ()),
        *((rollout_label(key, figures.settle_s), value, of[key]) for key, value in values.items()),
        *(() if motion is None else _motion(motion, figures)),
        *((f"{rollout_label('ended_by', None)} {name}", f"{count}", "") for name, count in figures.ended_by.items()),
    ]
    of_numbers = rollout_label("non_finite", None)
    rows += [(f"{of_numbers}: {key}", f"{count}", "episodes") for key, count in figures.non_finite.items()]
    print_table(("figure", "value", "of"), rows)


def print_contacts(sensor: str, rows: list[ContactFigures]) -> None:
    """Print the contact force on each robot link that was measured while the robot stood still."""
    from wheelleg_exp.jobs.play_policy import SETTLE_S, UPRIGHT_RAD

    steps = _counted(rows[0].steps if rows else 0, "step")
    words = f"{sensor}: normal force at the end of a step, over {steps} of all episodes and environments, "
    words += f"at least {SETTLE_S:g} s after a reset and with a tilt below {UPRIGHT_RAD:g} rad"
    print(f"\n{hanging(words, 0)}")
    cells = [(r.body, f"{r.mean_n:.3f}", f"{r.max_n:.3f}", percent(r.contact_share)) for r in rows]
    print_table(("link", *(CONTACTS[key].heading for key in ("mean_n", "max_n", "contact_share"))), cells)


def print_recording(path: Path | None) -> None:
    """Print the path of a recording, and the command that opens the recording."""
    if path is not None:
        print(f"\nrecording: {shown(path)}\nopen it:   {tool('rerun')} {shown(path)}")


def _motion(motion: MotionFigures, figures: StandFigures) -> Iterator[tuple[str, str, str]]:
    """Yield table rows with metrics of the robot's motion; a metric with several actuator groups gets several rows."""
    ways, settled = _counted(figures.settled_episodes, "episode"), _settled(figures)
    found = vars(motion)
    for key, form in _MOTION.items():
        name, value = rollout_label(key, figures.settle_s), found[key]
        of = ways if MOTION[key].label.startswith(("strayed", "turned")) else settled
        if isinstance(value, dict):
            yield from ((f"{name} ({group})", form(each), of) for group, each in value.items())
        else:
            yield name, "-" if value is None else form(value), of


def _settled(figures: StandFigures) -> str:
    if not figures.settled_steps:
        return "no episode lasted that long"
    return f"{_counted(figures.settled_steps, 'step')} of {_counted(figures.settled_episodes, 'episode')}"


def _counted(count: int, one: str) -> str:
    return f"{count} {one}" if count == 1 else f"{count} {one}s"


def _millimetres(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{1e3 * value:.2f} mm"


def _degrees(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f} deg"


_DEGREES = {"rad": "°", "rad/s": "°/s"}


def wanted(names: Sequence[str], only: Sequence[str]) -> list[str]:
    """Return the names of metrics that match one of the patterns ``only``, or all names if there are no patterns.

    Raise WheellegError for a pattern that matches nothing.
    """
    for pattern in only:
        if not any(fnmatchcase(name, pattern) for name in names):
            expected, nearest = "the name of a metric, or a pattern such as '*/survival'", nearest_name(pattern, names)
            raise WheellegError("no metric matches this", key=pattern, expected=expected, nearest=nearest)
    return [name for name in names if not only or any(fnmatchcase(name, pattern) for pattern in only)]


def print_evaluation(content: Mapping[str, Any], only: Sequence[str] = ()) -> None:
    """Print the content of ``evaluation.json``: one table for each group of metrics, with angles in degrees.

    ``only`` contains patterns of the metrics to print; empty prints all.
    """
    about, protocol = content["about"], content["protocol"]
    dt, step = about.get("physics_dt_s"), about.get("step_dt_s")
    print(f"protocol {protocol['name']}, seed {content['seed']}, scenarios {content['scenarios_sha256'][:12]}")
    print(f"robot profile {about.get('profile')}, {about.get('engine')}, physics step {dt:.6g} s, control {step:.6g} s")
    for group, found in groupby(wanted(list(content["metrics"]), only), lambda name: name.split("/")[0]):
        print()
        names = list(found)
        rows = [_row(name, content["metrics"][name]) for name in names if content["metrics"][name]["episodes"]]
        print_table((group, "value", "95 % interval", "unit", "episodes"), rows)
        _print_unmeasured([name.split("/", 1)[1] for name in names if not content["metrics"][name]["episodes"]])


def _print_unmeasured(names: Sequence[str]) -> None:
    if names:
        print(hanging(f"no episode has a value for: {', '.join(names)}", 4))


def _row(name: str, figure: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    factor, unit = _scale(figure["unit"])
    ends = [figure[key] for key in ("value", "low", "high")]
    value, low, high = ("-" if end is None else f"{end * factor:.4g}" for end in ends)
    return name.split("/", 1)[1], value, _between(value, low, high), unit, str(figure["episodes"])


def print_comparison(
    made: Compared, runs: Sequence[Evaluated], reference: Evaluated | None, only: Sequence[str] = ()
) -> None:
    """Print one table with the metrics of the evaluated runs and of the linear-quadratic reference controller."""
    from wheelleg_exp.jobs.compare_evaluations import display_name

    print(f"protocol {made.content['protocol']}, scenarios {made.content['scenarios_sha256'][:12]}")
    for number, run in enumerate(runs, start=1):
        print(f"run {number}: {display_name(run)}")
    several = len(runs) > 1
    columns = ["metric", "unit", *(f"run {number}" for number in range(1, len(runs) + 1))]
    columns += ["mean", "95 % interval", "noise floor"] if several else []
    columns += ["reference"] if reference is not None else []
    rows, unmeasured = [], []
    names = wanted([row.metric for row in made.seeds], only)
    for row in (row for row in made.seeds if row.metric in names):
        factor, unit = _scale(row.unit)
        cells = [_number(value, factor) for value in row.values]
        if several:
            mean = [_number(x, factor) for x in (row.mean.value, row.mean.low, row.mean.high)]
            cells += [mean[0], _between(*mean), _number(row.mean.floor, factor)]
        if reference is not None:
            figure = reference.evaluation.metrics.get(row.metric)
            cells.append("-" if figure is None else _number(figure.value, factor))
        if set(cells) == {"-"}:
            unmeasured.append(row.metric)
        else:
            rows.append((row.metric, unit, *cells))
    print_table(columns, rows, heads=1)
    _print_unmeasured(unmeasured)
    if several:
        print(hanging("intervals: bootstrap over the runs and, within each run, over its episodes", 0))


def print_differences(made: Compared, only: Sequence[str] = ()) -> None:
    """For each metric, print the difference between two groups of runs, and a sentence that names the better group."""
    names = wanted([row.metric for row in made.seeds], only)
    found = (row for row in made.differences if row.metric in names and row.better)
    rows = [_difference(row) for row in found if math.isfinite(row.interval.value)]
    print()
    print_table(("metric", "unit", "these", "those", "difference", "95 % interval", "test", "p", "is"), rows)
    print(hanging("p: two-sided, paired if episodes have equal starts, corrected for all tests (Holm)", 0))
    for verdict in filter(None, (made.push_verdict, made.verdict)):
        print(f"\n{hanging(verdict, 0)}")


def _difference(row: Difference) -> tuple[str, ...]:
    factor, unit = _scale(row.unit)
    found = row.interval
    test = ("", "") if row.test is None or row.p is None else (row.test.test, f"{row.p:.2g}")
    numbers = [_number(x, factor) for x in (row.first, row.second, found.value, found.low, found.high)]
    return row.metric, unit, *numbers[:3], _between(*numbers[2:]), *test, row.outcome or "-"


def _scale(unit: str) -> tuple[float, str]:
    return (180.0 / math.pi if unit in _DEGREES else 1.0), _DEGREES.get(unit, unit)


def _between(value: str, low: str, high: str) -> str:
    """Return the interval of a printed value, or an empty text if both ends equal the value."""
    return "-" if "-" in (low, high) else "" if value == low == high else f"{low} to {high}"


def _number(value: float, factor: float) -> str:
    return f"{value * factor:.3g}" if math.isfinite(value) else "-"
