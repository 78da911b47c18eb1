"""Headline of a report: one sentence on whether the robot stands, and the key figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from datetime import datetime

from wheelleg_exp.definitions import LAST, settled_window
from wheelleg_exp.inspection.plot_data import target_height
from wheelleg_exp.report.page_blocks import Card, Tone
from wheelleg_exp.report.report_subject import AGENT, Subject, is_number
from wheelleg_exp.report.value_format import counted, duration, exact, moment, number, numbers, percent

_GOOD, _FAIR = 0.95, 0.5  # The share of episodes with a time-out is green from 95 %, yellow from 50 %, red below.
# ``TONES`` maps the status of a run to the colour of this status in the report.
TONES: Mapping[str, Tone] = {"finished": "good", "failed": "bad", "crashed": "bad", "interrupted": "warn"}


def played(subject: Subject) -> Mapping[str, object]:
    """Return the metrics of the last ``wheelleg play`` or of a zero or random agent's run; {} without metrics."""
    if subject.status == AGENT:
        figures = subject.agent_figures.get("figures")
        return numbers(figures) if isinstance(figures, Mapping) else {}
    plays = subject.additions("play")
    return numbers(plays[-1].results) if plays else {}


def settle_s(figures: Mapping[str, object]) -> float | None:
    """Return the duration at the start of an episode that the figures ignore, s; None if it is unknown."""
    found = figures.get("settle_s")
    return found if is_number(found) else None


def ended(figures: Mapping[str, object]) -> int | None:
    """Return how many episodes ended during ``wheelleg play``; None if the number of ended episodes is unknown."""
    episodes, unfinished = figures.get("episodes"), figures.get("unfinished", 0)
    return episodes - unfinished if isinstance(episodes, int) and isinstance(unfinished, int) else None


def planned(subject: Subject) -> int | None:
    """Return the planned number of training iterations, from the run's config or from an override of a resume."""
    found = subject.setting("agent.max_iterations")
    for entry in subject.manifest.resumes:
        for text in entry.overrides:
            key, _, value = text.lstrip("+").partition("=")
            found = int(value) if key == "agent.max_iterations" and value.isdigit() else found
    return found if isinstance(found, int) else None


def done(subject: Subject) -> int:
    """Return the number of training iterations that the run has finished."""
    last = max((series.at[-1] for series in subject.scalars.values()), default=-1)
    kept = subject.manifest.results.get("iterations")
    return kept if isinstance(kept, int) and subject.status == "finished" else last + 1


def seconds(subject: Subject) -> float | None:
    """Return the duration of a training, s, from the training's results or from its start and end."""
    # The time between a run's stop and its resume is unknown, so the duration of a resumed run is None.
    manifest = subject.manifest
    if manifest.resumes:
        return None
    kept = manifest.results.get("seconds")
    if isinstance(kept, (int, float)):
        return float(kept)
    if manifest.ended is None:
        return None
    return (datetime.fromisoformat(manifest.ended) - datetime.fromisoformat(manifest.started)).total_seconds()


def time_outs(subject: Subject) -> list[str]:
    """Return the names of the termination terms with the config value ``time_out: true``."""
    terms = subject.setting("env.terminations")
    found = terms.items() if isinstance(terms, Mapping) else ()
    return [str(name) for name, term in found if isinstance(term, Mapping) and term.get("time_out")]


def reached_end(subject: Subject) -> float | None:
    """Return the share of environments in which the last training episode reached the time-out without a failure."""
    # In old runs, an episode with a time-out and a failure in the same control step counts as a time-out.
    names, counts = time_outs(subject), subject.manifest.last_ended_by
    if sum(counts.values()):
        survived = [count for ended_by, count in counts.items() if set(ended_by.split(" and ")) <= set(names)]
        return sum(survived) / sum(counts.values())
    shares = [subject.last(f"Episode_Termination/{name}") for name in names]
    return max((share for share in shares if share is not None), default=None)


def sentence(subject: Subject) -> str:
    """Return one or two sentences about the outcome of a run."""
    figures, status = played(subject), subject.status
    if status == AGENT:
        agent = str(subject.agent_figures.get("agent", "an agent without a policy"))
        return f"No policy: the {agent} agent's actions on this task. {_stood(subject, figures)}".strip()
    count, total = done(subject), planned(subject)
    progress = f"iteration {number(count)} of {number(total)}" if total else counted(count, "iteration")
    if status == "running":
        return f"Training is running: {progress} is done. {_stood(subject, figures)}".strip()
    if status != "finished":
        error = subject.manifest.error
        why = f": {error.message}" if error and error.message else ""
        broken = {
            "interrupted": f"Training was interrupted after {progress}; it can be resumed.",
            "crashed": f"The process of this training died; {progress} was written. It can be resumed.",
        }.get(status, f"Training failed after {progress}{why.rstrip('.')}.")
        return f"{broken} {_stood(subject, figures)}".strip()
    if figures:
        return _stood(subject, figures)
    share = reached_end(subject)
    tail = "" if share is None else f" In {percent(share)} of the environments the last episode ran to the time-out."
    return f"Trained for {counted(count, 'iteration')}.{tail} The policy has not been played yet."


def _stood(subject: Subject, figures: Mapping[str, object]) -> str:
    episodes, survival = ended(figures), figures.get("survival")
    if not episodes or not isinstance(survival, (int, float)):
        return ""
    length = subject.setting("env.episode_length_s")
    full = f" of {exact(length)} s" if isinstance(length, (int, float)) else ""
    stood = round(survival * episodes)
    who = "It" if subject.status == AGENT else "The policy"
    some, every = f"{number(stood)} of {number(episodes)} episodes", f"every one of {counted(episodes, 'episode')}"
    if episodes == 1:
        some = every = "its one episode"
    elif stood == episodes:
        some = f"all {counted(episodes, 'episode')}"
    text = f"{who} stays up through {some}{full}" if stood else f"{who} falls in {every}{full}"
    error, goal = figures.get("height_rmse_m"), target_height(subject.setting("env.rewards"))
    if not stood or not isinstance(error, (int, float)) or goal is None:
        return text + "."
    when = settled_window(settle_s(figures))
    return f"{text}, {number(1e3 * error, 2)} mm (RMS, {when}) off its target height of {exact(1e3 * goal)} mm."


def cards(subject: Subject, verdict: Card | None) -> list[Card]:
    """Return the key figures: the plays first, then the training, then reproducibility."""
    figures = played(subject)
    found = list(_of_play(subject, figures) if figures else _of_training(subject))
    if subject.status != AGENT:
        count, total, spent = done(subject), planned(subject), seconds(subject)
        note = f"in {duration(spent)}" if spent is not None else ""
        if total and count < total:
            note = f"of {number(total)} planned" + (f", {note}" if note else "")
        found.append(Card("Iterations", number(count), "", note))
    return [*found, *([verdict] if verdict else [])]


def _of_play(subject: Subject, figures: Mapping[str, object]) -> Iterator[Card]:
    survival, episodes, when = figures.get("survival"), ended(figures), settled_window(settle_s(figures))
    if isinstance(survival, (int, float)) and episodes:
        note = f"{number(round(survival * episodes))} of {counted(episodes, 'episode')} reached the time-out"
        yield _with_unit("Survival", percent(survival), note, tone_of(survival))
    height, error = figures.get("height_mean_m"), figures.get("height_rmse_m")
    goal = target_height(subject.setting("env.rewards"))
    if isinstance(height, (int, float)):
        note = ""
        if goal and isinstance(error, (int, float)):
            shown = number(1e3 * error, 2 if error < 0.01 else 3)
            note = f"; RMS error {shown} mm against {exact(1e3 * goal)} mm"
        yield Card("Base height", number(1e3 * height), "mm", f"mean {when}{note}")
    if is_number(figures.get("pitch_rms_deg")):
        lean = figures.get("pitch_mean_deg")
        note = f"; mean lean {number(lean, 2)}°" if is_number(lean) else ""
        yield Card("Pitch", number(figures["pitch_rms_deg"], 2), "°", f"RMS {when}{note}")
    turned, drift = figures.get("yaw_drift_deg"), figures.get("drift_m")
    if is_number(drift):
        note = f"; turned by {number(turned, 2)}°" if is_number(turned) else ""
        yield Card("Drift", number(1e3 * drift, 2), "mm", f"largest {when}, mean of its episodes{note}")
    torques = {group: value for group, value in _by_group(figures, "torque_rms_nm").items() if is_number(value)}
    if torques:
        group = max(torques, key=lambda name: torques[name])
        limit, signs = (_by_group(figures, key).get(group) for key in ("at_limit", "sign_changes_per_s"))
        note = f"RMS of the {group} {when}; {percent(limit)} at the limit; {number(signs, 2)} sign changes per s"
        yield Card("Torque", number(torques[group], 2), "N·m", note)
    if is_number(figures.get("action_rate_per_s")):
        yield Card("Action rate", number(figures["action_rate_per_s"], 2), "/s", f"mean change of an action {when}")
    if is_number(figures.get("power_net_w")):
        yield Card("Power", number(figures["power_net_w"], 2), "W", f"mechanical, net of armature, mean {when}")
    if is_number(figures.get("mean_return")):
        note = f"mean of {counted(episodes, 'ended episode')}" if episodes else "mean of an episode"
        yield Card("Return", number(figures["mean_return"]), "", note)


def _by_group(figures: Mapping[str, object], key: str) -> Mapping[str, object]:
    """Return the values of a figure by group of actuators; no values if the figure is missing."""
    found = figures.get(key)
    return found if isinstance(found, Mapping) else {}


def _of_training(subject: Subject) -> Iterator[Card]:
    share = reached_end(subject)
    if share is not None:
        note = "of the environments, in their last episode"
        yield _with_unit("Reached the time-out", percent(share), note, tone_of(share))
    steps, step_s = subject.last("Train/mean_episode_length"), subject.step_s
    if steps is not None and step_s is not None:
        length = subject.setting("env.episode_length_s")
        note = f", of {exact(length)} s at most" if is_number(length) else ""
        yield Card("Episode length", number(steps * step_s), "s", f"mean of {LAST}{note}")
    if subject.last("Train/mean_reward") is not None:
        yield Card("Return", number(subject.last("Train/mean_reward")), "", f"mean of {LAST}, with exploration")


def tone_of(share: float) -> Tone:
    """Return the colour for a share of episodes that reached the time-out, such as green (``good``) for 0.98."""
    return "good" if share >= _GOOD else "warn" if share >= _FAIR else "bad"


def facts(subject: Subject) -> list[tuple[str, str]]:
    """Return the facts of the run: robot, size, seed, time, machine."""
    manifest, choices = subject.manifest, subject.choices
    asset, profile = subject.setting("env.robot.asset"), subject.setting("env.robot.profile")
    robot = f"{asset} ({profile})" if asset and profile else str(asset or choices.get("robot") or "")
    seeds = manifest.seeds or [subject.config.get("seed")]
    envs, step = subject.setting("env.num_envs"), subject.step_s
    rows = [
        ("Task", subject.task),
        ("Robot", robot),
        ("Environments", number(envs) if is_number(envs) else ""),
        ("Control step", f"{number(1e3 * step)} ms" if step else ""),
        ("Seed", ", ".join(str(seed) for seed in seeds if seed is not None)),
        ("Started", moment(manifest.started) if manifest.started else ""),
        ("Ended", moment(manifest.ended) if manifest.ended else ""),
        ("Machine", str((manifest.hardware or {}).get("cpu") or "")),
    ]
    return [(name, value) for name, value in rows if value]


def _with_unit(label: str, text: str, note: str, mood: Tone) -> Card:
    value, _, unit = text.partition(" ")
    return Card(label, value, unit, note, mood)
