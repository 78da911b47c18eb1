"""The layout of Rerun's viewer: the robot on the left, plots and texts on the right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import rerun.blueprint as rrb

from wheelleg_exp.definitions import EPISODE_REWARD, curve_title
from wheelleg_exp.recording import layout
from wheelleg_exp.recording.layout import DOCUMENTS, TRAINING, EnvPaths, join, join_key

Purpose = Literal["training", "play", "evaluation"]
FIGURES = "figures"  # The recorded text document `figures` contains the metrics of an evaluation.
_BACKGROUND = (30, 33, 38)

_HEADLINES = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std", "Loss/learning_rate")
_GROUPS = {
    "Episode_Reward": f"Reward by term: {EPISODE_REWARD}",
    "Episode_Termination": "Last episode ended by, share of all environments",
    "Metrics_per_step": "Mean tracking errors",
    "Loss": "Losses",
}


@dataclass(frozen=True)
class EnvLayout:
    """The properties of one recorded environment that determine the layout of Rerun's viewer.

    ``root`` is the base's entity, ``size`` the robot's height, m. ``joints`` maps position-controlled joints to True.
    """

    label: str
    paths: EnvPaths
    root: str
    size: float
    command: str | None
    sensors: tuple[str, ...]
    joints: Mapping[str, bool]
    rewards: Sequence[str]
    observations: Mapping[str, Sequence[str]]


def blueprint(
    envs: Sequence[EnvLayout], purpose: Purpose, *, documents: Sequence[str], training: Sequence[str]
) -> rrb.Blueprint:
    """Return the layout of Rerun's viewer, in which the camera follows the robot of the first environment.

    ``purpose`` selects the first tab. ``documents`` names the recorded texts, ``training`` the training scalars.
    """
    tabs = [tab for env in envs for tab in _env_tabs(env, several=len(envs) > 1)]
    if purpose == "training":
        tabs.insert(0, _training(training))
    elif purpose == "evaluation":
        tabs.insert(0, _metrics(envs[0], FIGURES in documents))
    if documents:
        texts = [rrb.TextDocumentView(origin=join(DOCUMENTS, name), name=name) for name in documents]
        tabs.append(rrb.Tabs(*texts, name="Documents", active_tab=0))
    size, root = envs[0].size, envs[0].root
    distance = size * (1.0 + 0.6 * (len(envs) - 1))
    position, target, up = [1.3 * distance, -1.45 * distance, 1.1 * distance], [0.0, 0.0, 0.4 * size], [0.0, 0.0, 1.0]
    robot = rrb.Spatial3DView(
        origin="/",
        contents=[f"+ /{name}/**" for name in (layout.GROUND, layout.WORLD, layout.OVERLAY)],
        name="Robot",
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=position, look_target=target, eye_up=up, tracking_entity=root
        ),
        overrides={env.paths.overlay("colliders"): rrb.EntityBehavior(visible=False) for env in envs},
    )
    return rrb.Blueprint(
        rrb.Horizontal(robot, rrb.Tabs(*tabs, active_tab=0), column_shares=[5, 5]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # The viewer's time axis shows control steps for a training's recording, else simulated time.
        rrb.TimePanel(state="collapsed", timeline=layout.STEP if purpose == "training" else layout.SIM_TIME),
    )


def _env_tabs(env: EnvLayout, *, several: bool) -> list[rrb.Container | rrb.View]:
    data = env.paths.data
    joints = []
    # Draw one plot per joint, because a plot of joints at very different positions hides small tracking errors.
    for joint, is_held in env.joints.items():
        kind, unit = ("position", "rad") if is_held else ("velocity", "rad/s")
        parts = (data("joints", joint, part) for part in (kind, f"{kind}_target"))
        joints.append(_plot(f"{joint} {kind} ({unit})", *parts))
    efforts = _plot("Effort (N·m)", *(data("joints", joint, "effort") for joint in env.joints))
    tabs: list[rrb.Container | rrb.View] = [
        rrb.Vertical(*_motion_plots(env), name="Motion"),
        rrb.Grid(*joints, grid_columns=_columns(len(joints)), name="Joints"),
        rrb.Vertical(efforts, _plot("Raw action", data("actions", "raw")), name="Efforts"),
    ]
    if env.sensors:
        contacts = [_plot(f"{sensor} (N)", data("contacts", sensor)) for sensor in env.sensors]
        tabs.append(rrb.Vertical(*contacts, name="Contacts"))
    terms = _small_plots({term: data("rewards", term) for term in env.rewards})
    total = _plot("Reward (1/s)", data("rewards", "total"), legend=False)
    log = rrb.TextLogView(name="Episodes and events", contents=[f"+ /{data('log')}/**", "+ /log/**"])
    marks = _plot("Terminations and events", *(f"{data(name)}/**" for name in ("terminations", "events")))
    length = _plot("Steps since the reset", data("episode", "step"), legend=False)
    tabs.append(rrb.Vertical(total, terms, row_shares=[1, 4], name="Rewards"))
    tabs.append(rrb.Vertical(marks, length, log, name="Episodes"))
    if env.observations:
        entities = {g: {t: data("observations", g, t) for t in terms} for g, terms in env.observations.items()}
        groups = [_small_plots(plots, group) for group, plots in entities.items()]
        tabs.append(rrb.Tabs(*groups, name="Observations", active_tab=0))
    return [rrb.Tabs(*tabs, name=env.label, active_tab=0)] if several else tabs


def _plot(name: str, *entities: str, legend: bool = True) -> rrb.TimeSeriesView:
    shown = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(name=name, contents=[f"+ /{entity}" for entity in entities], plot_legend=shown)


def _small_plots(plots: Mapping[str, str], name: str | None = None) -> rrb.Grid:
    views = [_plot(title, entity, legend=False) for title, entity in plots.items()]
    return rrb.Grid(*views, grid_columns=_columns(len(views)), name=name)


def _columns(count: int) -> int:
    return 1 if count < 3 else 2 if count <= 8 else 3


def _motion_plots(env: EnvLayout) -> list[rrb.TimeSeriesView]:
    height, roll, pitch, *speeds = (env.paths.data("base", n) for n in ("height", "roll", "pitch", "v_x", "w_z"))
    asked = [] if env.command is None else [env.paths.data("commands", env.command, n) for n in ("v_x", "w_z")]
    return [
        _plot("Base height (m)", height, legend=False),
        _plot("Roll and pitch (rad)", roll, pitch),
        _plot("Forward velocity and command (m/s)", speeds[0], *asked[:1]),
        _plot("Yaw rate and command (rad/s)", speeds[1], *asked[1:]),
    ]


def _training(keys: Sequence[str]) -> rrb.Container | rrb.View:
    groups: dict[str, dict[str, str]] = {}
    for key in keys:
        group, _, rest = key.rpartition("/")
        groups.setdefault(group or TRAINING, {})[rest] = join_key(TRAINING, key)
    if not groups:
        return _plot("Learning", f"{TRAINING}/**")
    plots = [_plot(curve_title(key), join_key(TRAINING, key), legend=False) for key in _HEADLINES if key in keys]
    for group, title in _GROUPS.items():
        members = [join_key(TRAINING, k) for k in keys if k.startswith(f"{group}/") and k not in _HEADLINES]
        plots += [_plot(title, *members)] if members else []
    overview = rrb.Grid(*plots, grid_columns=_columns(len(plots)), name="Overview")
    tabs = [overview, *(_small_plots(entities, name) for name, entities in groups.items())]
    return rrb.Tabs(*tabs, name="Learning", active_tab=0)


def _metrics(env: EnvLayout, has_figures: bool) -> rrb.Vertical:
    plots = [*_motion_plots(env), _plot("Reward (1/s)", env.paths.data("rewards", "total"), legend=False)]
    plots.append(_plot("Terminations", f"{env.paths.data('terminations')}/**"))
    grid = rrb.Grid(*plots, grid_columns=2)
    if not has_figures:
        return rrb.Vertical(grid, name="Metrics")
    text = rrb.TextDocumentView(origin=join(DOCUMENTS, FIGURES), name="Figures")
    return rrb.Vertical(grid, text, row_shares=[3, 2], name="Metrics")
