"""What is said in words: ends of episodes and events."""

from __future__ import annotations

from dataclasses import dataclass

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.frames import Stamp

EPISODES, EVENTS = "episodes", "events"


@dataclass(frozen=True)
class Entry:
    """One line of the log.

    Attributes:
        stamp: when.
        kind: ``EPISODES``, ``EVENTS``, or what else there is to say.
        text: what.
        level: severity by rerun's names.
    """

    stamp: Stamp
    kind: str
    text: str
    level: str


def episode_end(env: ManagerBasedRLEnv, env_id: int, stamp: Stamp) -> Entry | None:
    """Return what ended the environment's episode in this step, None when it goes on."""
    manager = env.termination_manager
    failed = bool(manager.terminated.numpy()[env_id])
    if not failed and not manager.time_outs.numpy()[env_id]:
        return None
    reasons = [name for name in manager.active_terms if manager.get_fired(name)[env_id]]
    seconds = int(env.episode_length_buf[env_id]) * env.step_dt
    text = f"env {env_id}: ended by {' and '.join(reasons) or 'a reward that is not finite'} after {seconds:.2f} s"
    return Entry(stamp, EPISODES, text, "WARN" if failed else "INFO")


def fired(env: ManagerBasedRLEnv, env_id: int) -> list[str]:
    """Return the interval events that fired for the environment when they were last due."""
    # A timer that all environments share has one flag.
    return [name for name, due in env.event_manager.fired.items() if due.numpy()[env_id if len(due) > 1 else 0]]
