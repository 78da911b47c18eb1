"""The layout of the viewer: the robot on the left, plots and texts on the right.

A training opens with its learning curves, a play with the robot's motion, an evaluation with its metrics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import rerun.blueprint as rrb

from wheelleg_exp.definitions import EPISODE_REWARD, curve_title
from wheelleg_exp.recording.layout import (
    DOCUMENTS,
    GROUND,
    OVERLAY,
    SIM_TIME,
    STEP,
    TRAINING,
    WORLD,
    EnvPaths,
    join,
    join_key,
)

Purpose = Literal["training", "play", "evaluation"]
FIGURES = "figures"  # the name of the text with the measured figures
_BACKGROUND = (30, 33, 38)

# Keys that a training does not have are left out.
_HEADLINES = ("Train/mean_reward", "Train/mean_episode_length", "Policy/mean_std", "Loss/learning_rate")
_GROUPS = {
    "Episode_Reward": f"Reward by term: {EPISODE_REWARD}",
    "Episode_Termination": "Last episode ended by, share of all environments",
    "Metrics_per_step": "Mean tracking errors",
    "Loss": "Losses",
}


@dataclass(frozen=True)
class EnvLayout:
    """The facts about one recorded environment that its layout needs.

    Attributes:
        label: name of its tab.
        paths: its entity paths.
        root: entity of the base.
        size: height of the robot, m.
        command: name of the velocity command.
        sensors: names of the contact sensors.
        joints: whether each joint is position-controlled (by its stiffness); the others are velocity-controlled.
        rewards: names of the reward terms.
        observations: names of each group's terms.
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
    """Return the layout.

    Args:
        envs: the recorded environments; the camera follows the first.
        purpose: decides which tab is first.
        documents: names of the texts so far.
        training: keys of the training scalars so far.
    """
    tabs = [tab for env in envs for tab in _env_tabs(env, several=len(envs) > 1)]
    if purpose == "training":
        tabs.insert(0, _training(training))
    elif purpose == "evaluation":
        tabs.insert(0, _metrics(envs[0], FIGURES in documents))
    if documents:
        tabs.append(_documents(documents))
    return rrb.Blueprint(
        rrb.Horizontal(robot_view(envs), rrb.Tabs(*tabs, active_tab=0), column_shares=[5, 5]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        # The samples of a training are far apart. On the timeline of steps, its curves and its motion match.
        rrb.TimePanel(state="collapsed", timeline=STEP if purpose == "training" else SIM_TIME),
    )


def robot_view(envs: Sequence[EnvLayout]) -> rrb.Spatial3DView:
    """Return the 3D view: the camera follows the first robot, and colliders are hidden."""
    first = envs[0]
    distance = first.size * (1.0 + 0.6 * (len(envs) - 1))
    hidden = {env.paths.overlay("colliders"): rrb.EntityBehavior(visible=False) for env in envs}
    return rrb.Spatial3DView(
        origin="/",
        contents=[f"+ /{GROUND}/**", f"+ /{WORLD}/**", f"+ /{OVERLAY}/**"],
        name="Robot",
        background=rrb.Background(color=_BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=[1.3 * distance, -1.45 * distance, 1.1 * distance],
            look_target=[0.0, 0.0, 0.4 * first.size],
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=first.root,
        ),
        overrides=hidden,
    )


def _env_tabs(env: EnvLayout, *, several: bool) -> list[Any]:
    tabs = [_motion(env), _joints(env), _actuation(env), *([_contacts(env)] if env.sensors else [])]
    tabs += [_rewards(env), _episodes(env), *([_observations(env)] if env.observations else [])]
    if several:
        return [rrb.Tabs(*tabs, name=env.label, active_tab=0)]
    return tabs


def _plot(name: str, *entities: str, legend: bool = True) -> rrb.TimeSeriesView:
    """Return a plot of entities; a path that ends with ``/**`` includes all paths below it."""
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{entity}" for entity in entities],
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
    )


def _small_plots(plots: Mapping[str, str], name: str | None = None) -> rrb.Grid:
    """Return one small plot for each entity (by title), for numbers of very different magnitude."""
    views = [_plot(title, entity, legend=False) for title, entity in plots.items()]
    return rrb.Grid(*views, grid_columns=_columns(len(views)), name=name)


def _columns(count: int) -> int:
    return 1 if count < 3 else 2 if count <= 8 else 3


def _motion(env: EnvLayout) -> Any:
    return rrb.Vertical(*_motion_plots(env), name="Motion")


def _motion_plots(env: EnvLayout) -> list[Any]:
    def base(name: str) -> str:
        return env.paths.data("base", name)

    forward, turning = [base("v_x")], [base("w_z")]
    if env.command is not None:
        forward.append(env.paths.data("commands", env.command, "v_x"))
        turning.append(env.paths.data("commands", env.command, "w_z"))
    return [
        _plot("Base height (m)", base("height"), legend=False),
        _plot("Roll and pitch (rad)", base("roll"), base("pitch")),
        _plot("Forward velocity and command (m/s)", *forward),
        _plot("Yaw rate and command (rad/s)", *turning),
    ]


def _joints(env: EnvLayout) -> Any:
    """One plot for each joint, because joints at distant positions would hide each other's tracking errors."""
    plots = []
    for joint, is_held in env.joints.items():
        kind, unit = ("position", "rad") if is_held else ("velocity", "rad/s")
        entities = [env.paths.data("joints", joint, part) for part in (kind, f"{kind}_target")]
        plots.append(_plot(f"{joint} {kind} ({unit})", *entities))
    return rrb.Grid(*plots, grid_columns=_columns(len(plots)), name="Joints")


def _actuation(env: EnvLayout) -> Any:
    efforts = [env.paths.data("joints", joint, "effort") for joint in env.joints]
    actions = env.paths.data("actions", "raw")
    return rrb.Vertical(_plot("Effort (N·m)", *efforts), _plot("Raw action", actions), name="Efforts")


def _contacts(env: EnvLayout) -> Any:
    plots = [_plot(f"{sensor} (N)", env.paths.data("contacts", sensor)) for sensor in env.sensors]
    return rrb.Vertical(*plots, name="Contacts")


def _rewards(env: EnvLayout) -> Any:
    terms = {term: env.paths.data("rewards", term) for term in env.rewards}
    total = _plot("Reward (1/s)", env.paths.data("rewards", "total"), legend=False)
    return rrb.Vertical(total, _small_plots(terms), row_shares=[1, 4], name="Rewards")


def _episodes(env: EnvLayout) -> Any:
    log = rrb.TextLogView(name="Episodes and events", contents=[f"+ /{env.paths.data('log')}/**", "+ /log/**"])
    marks = [f"{env.paths.data(name)}/**" for name in ("terminations", "events")]
    length = _plot("Steps since the reset", env.paths.data("episode", "step"), legend=False)
    return rrb.Vertical(_plot("Terminations and events", *marks), length, log, name="Episodes")


def _observations(env: EnvLayout) -> Any:
    """One tab for each group, one plot for each term: the inputs of the networks."""
    groups = []
    for group, terms in env.observations.items():
        plots = {term: env.paths.data("observations", group, term) for term in terms}
        groups.append(_small_plots(plots, group))
    return rrb.Tabs(*groups, name="Observations", active_tab=0)


def _training(keys: Sequence[str]) -> Any:
    """The headlines first, then one tab for each group of keys and one plot for each key."""
    groups: dict[str, dict[str, str]] = {}
    for key in keys:
        group, _, rest = key.rpartition("/")
        groups.setdefault(group or TRAINING, {})[rest] = join_key(TRAINING, key)
    if not groups:
        return _plot("Learning", f"{TRAINING}/**")
    tabs = [_overview(keys), *(_small_plots(g, name) for name, g in groups.items())]
    return rrb.Tabs(*tabs, name="Learning", active_tab=0)


def _overview(keys: Sequence[str]) -> Any:
    """The curves that summarize the training, as far as they exist."""
    plots = [_plot(curve_title(key), join_key(TRAINING, key), legend=False) for key in _HEADLINES if key in keys]
    for group, words in _GROUPS.items():
        members = [key for key in keys if key.startswith(f"{group}/") and key not in _HEADLINES]
        found = [join_key(TRAINING, key) for key in members]
        if found:
            plots.append(_plot(words, *found))
    return rrb.Grid(*plots, grid_columns=_columns(len(plots)), name="Overview")


def _metrics(env: EnvLayout, has_figures: bool) -> Any:
    """The metrics as text and over time."""
    plots = [*_motion_plots(env), _plot("Reward (1/s)", env.paths.data("rewards", "total"), legend=False)]
    plots.append(_plot("Terminations", f"{env.paths.data('terminations')}/**"))
    grid = rrb.Grid(*plots, grid_columns=2)
    if not has_figures:
        return rrb.Vertical(grid, name="Metrics")
    text = rrb.TextDocumentView(origin=join(DOCUMENTS, FIGURES), name="Figures")
    return rrb.Vertical(grid, text, row_shares=[3, 2], name="Metrics")


def _documents(names: Sequence[str]) -> Any:
    views = [rrb.TextDocumentView(origin=join(DOCUMENTS, name), name=name) for name in names]
    return rrb.Tabs(*views, name="Documents", active_tab=0)
