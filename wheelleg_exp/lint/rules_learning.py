"""Rules about what can be learned: sizes of rewards against each other, discount, batch, and curricula."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from wheelleg_exp.lint import reward_tolerances as tolerances
from wheelleg_exp.lint.rule import Case, Finding, TermView, above, at_least, at_most, by_joint, largest, rule

_AUDIBLE = 0.01  # An error as large as a reward term's tolerance should cost at least 1 % of the total best reward.
_OUTWEIGHS = 4.0  # A penalty above four times the sum of all positive rewards is implausible.
_STILL = 0.5  # A robot at rest should earn less than 50 % of a tracking reward.


def still_score(speed: float, std: float) -> float:
    """Return the mean of exp(-c²/std²) over commands c uniform in ±speed: the reward of standing still."""
    return 1.0 if speed == 0.0 else math.sqrt(math.pi) / 2 * math.erf(speed / std) * std / speed


@rule
def tracking_std(case: Case) -> Iterator[Finding]:
    """A tracking reward is so tolerant that a robot earns most of it without following the command.

    If commands are uniform in ±V, a robot at rest earns on average sqrt(pi)/2 · erf(V/std) · std/V of the reward
    exp(-error²/std²). If all commands are zero, a robot that drifts with a wheel action of 1 must earn less than half
    of the tracking reward. Source: the integral of exp(-error²/std²) over the commands.
    """
    for term in case.terms("rewards", *tolerances.TRACKING):
        std, size = float(term.node["std"]), tolerances.command_size(case, term)
        yield from _moving(case, term, std, size) if size > 0.0 else _drifting(case, term, std)


@rule
def reward_outweighs(case: Case) -> Iterator[Finding]:
    """With random actions, as at the start of training, one penalty is far larger than all positive rewards.

    The policy first learns to avoid this penalty, for example by a fall that ends the episode. Only `wheelleg doctor
    task=…` simulates random actions. Source: means over two seconds of standard normal actions in 32 environments.
    """
    trial = case.trial or {}
    earned = sum(value for value in trial.values() if value > 0.0)
    for term in case.terms("rewards"):
        cost = -trial.get(term.name, 0.0)
        if term.kind in tolerances.FAILURES or cost <= _OUTWEIGHS * earned:
            continue
        weight = float(term.node["weight"])
        key, right = f"{term.path}.weight", at_most(abs(weight) * _OUTWEIGHS * earned / cost, 2)
        times = f"{cost / earned:.2g} times" if earned > 0.0 else "above"
        message = f"costs {cost:.3g} per second under random actions, {times} the {earned:.3g} of all rewards"
        hint = f"a weight near {math.copysign(right, weight):g}, or smaller scales of actions"
        yield Finding(key, message, hint, {"cost_per_s": cost, "earned_per_s": earned})


def _moving(case: Case, term: TermView, std: float, size: float) -> Iterator[Finding]:
    unit, score, narrow = tolerances.UNITS[tolerances.TRACKING[term.kind]], still_score(size, std), at_most(size / 2)
    if score < _STILL:
        return
    standing = float(case.env.commands[term.node["command_name"]].get("rel_standing_envs", 0.0))
    yield Finding(
        f"{term.path}.std",
        f"with std {std:g} {unit} and commands in ±{size:g} {unit}, a robot that never moves earns {score:.2f} of the "
        f"reward ({score + standing * (1 - score):.2f} with {100 * standing:.0f} % standing commands)",
        f"a std near {narrow:g} {unit} leaves it {still_score(size, narrow):.2f}",
        {"std": std, "range": size, "still": score},
        ({f"{term.path}.std": narrow},),
    )


def _drifting(case: Case, term: TermView, std: float) -> Iterator[Finding]:
    kind = tolerances.TRACKING[term.kind]
    unit = tolerances.UNITS[kind]
    # ``drift`` is the robot's speed (m/s) at a wheel action of 1; without wheel actions, a tenth of its top speed.
    drift = 0.1 * case.facts.top_speed
    for action in case.terms("actions", "actions.JointVelocityAction"):
        scales = by_joint(action.node.get("scale", 1.0), case.joints(action.node), 1.0)
        driven = [abs(float(scale)) for name, scale in scales.items() if name in case.facts.wheels]
        if driven:
            drift = max(driven) * case.facts.wheel_radius
            break
    if kind == "ang":
        drift = 2 * drift / case.facts.track if case.facts.track else 0.0
    score = math.exp(-((drift / std) ** 2))
    if drift == 0.0 or score < _STILL:
        return
    off = "; its weight is 0 here" if float(term.node["weight"]) == 0.0 else ""
    narrow = at_most(drift)
    yield Finding(
        f"{term.path}.std",
        f"only zero is commanded: standing still earns the whole reward, and with std {std:g} {unit} a drift of "
        f"{drift:.2g} {unit}, one unit of wheel action, still earns {score:.2f}{off}",
        f"a std near {narrow:g} {unit} or below",
        {"std": std, "range": 0.0, "drift": drift, "still": 1.0, "drifting": score},
        ({f"{term.path}.std": narrow},),
    )


@rule
def reward_too_small(case: Case) -> Iterator[Finding]:
    """A robot loses almost no reward for an error such as a tilt of 0.1 rad.

    Reward weights are multiplied by the control time step, so the size of a weight alone is meaningless. If an
    acceptable error costs less than 1 % of a perfect robot's reward, the noise of the return hides the cost. Source:
    Isaac Lab 2.3.2, ``isaaclab/managers/reward_manager.py``: value · weight · dt.
    """
    found = tolerances.contributions(case)
    best = tolerances.earned_per_second(found)
    for item in found:
        cost = abs(item.weight) * item.cost
        if item.once or item.value is None or cost == 0.0 or best <= 0.0 or cost >= _AUDIBLE * best:
            continue
        # The smallest weight at which the error costs 1 % of a perfect robot's reward.
        others, gain = best - item.weight * item.best, item.cost - _AUDIBLE * item.best
        weight = at_least(_AUDIBLE * others / gain) if gain > 0.0 and others > 0.0 else None
        key, weight = (
            f"{item.term.path}.weight",
            -at_least(_AUDIBLE * best / item.cost) if item.weight < 0.0 else weight,
        )
        yield Finding(
            key,
            f"being off by {item.tolerance} costs {cost * case.episode_s:.2g} of {best * case.episode_s:.3g} in an "
            f"episode: {100 * cost / best:.2g} %",
            "a narrower std: no weight makes it 1 %" if weight is None else f"a weight near {weight:g} makes it 1 %",
            {"cost_per_s": cost, "best_per_s": best, "share": cost / best},
            () if weight is None else ({key: weight},),
        )


@rule
def falling_pays(case: Case) -> Iterator[Finding]:
    """The robot earns more if it falls than if it continues the episode.

    Continuing an episode is worth the sum of the rewards that a robot with small, acceptable errors receives. Rewards
    are summed over the episode or over the discount's horizon 1/(1 - gamma), whichever is shorter. If continuing an
    episode is worth less than a failure, the policy learns to fall. Source: the return of PPO, Schulman et al. 2017.
    """
    found = tolerances.contributions(case)
    living = sum(c.weight * (c.value or 0.0) for c in found if not c.once)
    failing = sum(c.weight * (c.value or 0.0) for c in found if c.term.kind in tolerances.FAILURES)
    steps = min(horizon_steps(case), case.episode_steps)
    if living * steps < failing or (living < 0.0 and failing == 0.0):
        yield Finding(
            "env.rewards",
            f"to continue is worth {living * case.step_dt:.3g} per step at the tolerances, "
            f"{living * steps * case.step_dt:.3g} over {steps:.0f} steps, and a failure {failing * case.step_dt:.3g} "
            "once: falling at once pays",
            "a larger reward for being alive, or a more expensive failure",
            {"living_per_s": living, "failing": failing, "steps": steps},
        )


def horizon_steps(case: Case) -> float:
    """Return the discount's horizon 1/(1 - gamma) in control steps; inf without discount."""
    gamma = float(case.agent.algorithm.get("gamma", 0.99))
    return 1.0 / (1.0 - gamma) if gamma < 1.0 else math.inf


_GAMMA = "agent.algorithm.gamma"
_AVERAGE = "agent.average_iterations"
_DUST = 1e-9  # Comparisons allow for this relative rounding error of 1 - gamma.
_FALLS = 5.0  # The discount horizon must be at least five time constants of a robot's fall.
_EARLY = 0.25  # At most 25 % of a policy's averaged weights should come from the first training iterations.


@rule
def ppo_batch(case: Case) -> Iterator[Finding]:
    """The batch size is not a multiple of the number of mini-batches.

    rsl_rl cuts the batch of num_envs · num_steps_per_env samples into mini-batches of equal size and drops the
    remainder. Source: rsl_rl, ``storage/rollout_storage.py``.
    """
    batch = case.env.num_envs * case.agent.num_steps_per_env
    parts = int(case.agent.algorithm.get("num_mini_batches", 1))
    if batch % parts:
        message = f"{batch} samples in {parts} mini-batches of {batch // parts} leave {batch % parts} unused"
        hint = "a number of environments or steps that the mini-batches divide"
        figures: dict[str, float] = {"batch": batch, "mini_batches": parts, "unused": batch % parts}
        yield Finding("agent.algorithm.num_mini_batches", message, hint, figures)


@rule
def discount_horizon(case: Case) -> Iterator[Finding]:
    """The discount horizon 1/(1 - gamma) is longer than an episode, or shorter than the time in which a robot falls.

    A reward that is 1/(1 - gamma) steps in the future counts 1/e. With a horizon beyond the episode, the agent
    optimises rewards that it cannot receive; with one shorter than a fall (about five time constants of the robot's
    unstable pole), it cannot learn which action caused the fall. Source: the discounted return.
    """
    steps = horizon_steps(case)
    seconds = steps * case.step_dt
    balance = case.facts.balance
    fall = _FALLS / balance.pole if balance is not None else 0.0
    if steps > case.episode_steps * (1 + _DUST):
        message = f"the discount's horizon is {seconds:.3g} s, and an episode lasts {case.episode_s:g} s"
        figures = {"horizon_s": seconds if math.isfinite(seconds) else -1.0, "episode_s": case.episode_s}
        yield _advised(case, fall, message, figures, "most", at_least(1.0 / case.episode_steps, 3))
    if balance is not None and seconds < fall * (1 - _DUST):
        message = f"the discount's horizon is {seconds:.3g} s, {seconds * balance.pole:.2g} time constants of the fall"
        figures = {"horizon_s": seconds, "time_constant_s": 1 / balance.pole}
        yield _advised(case, fall, message, figures, "least", at_most(case.step_dt / fall, 3))


def _advised(case: Case, fall: float, message: str, figures: dict[str, float], bound: str, share: float) -> Finding:
    """Recommend ``gamma`` = 1 - ``share``, or longer episodes if an episode is shorter than a robot's fall."""
    if case.episode_s < fall:
        hint = f"episodes longer than {fall:.2g} s first: no gamma covers a fall and ends within an episode"
        return Finding(_GAMMA, message, hint, figures)
    gamma = round(1.0 - share, 12)
    return Finding(_GAMMA, message, f"gamma of at {bound} {gamma:g}", figures, ({_GAMMA: gamma},))


@rule
def late_average(case: Case) -> Iterator[Finding]:
    """The averaged policy weights depend too much on the first training iterations.

    In the first n = ``average_iterations`` iterations, the average m is the mean of the weights of all iterations so
    far; later, each iteration adds (w - m) / n. After i iterations, the first n have the share (1 - 1/n)^(i - n) of the
    average. With ``init_from``, the first iterations are not random, and the rule does not apply. Source: the weights
    of an exponential mean.
    """
    reach, iterations = case.agent.average_iterations, case.agent.max_iterations
    if reach < 2 or case.config.init_from:
        return
    early = (1.0 - 1.0 / reach) ** max(iterations - reach, 0)
    if early > _EARLY:
        # The share (1 - 1/n)^(i - n) is at most exp(1 - i/n), so solve exp(1 - i/n) = ``_EARLY`` for n.
        few = int(iterations / (1.0 - math.log(_EARLY)))
        enough = few if few > 1 else 0  # 0 disables the mean
        message = f"{100 * early:.0f} % of the mean is from iterations 1 to {min(reach, iterations)} of {iterations}"
        hint = f"at most {enough}, or more iterations"
        yield Finding(_AVERAGE, message, hint, {"early_share": early}, ({_AVERAGE: enough},))


@rule
def noop_curriculum(case: Case) -> Iterator[Finding]:
    """A curriculum term has no effect: it keeps a reward's weight, or changes the weight after the end of training.

    The curriculum term changes the weight of a reward after ``num_steps`` control steps. A training has max_iterations
    · num_steps_per_env control steps. Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/curriculums.py``.
    """
    total = case.agent.max_iterations * case.agent.num_steps_per_env
    for term in case.terms("curriculum", "curriculums.modify_reward_weight"):
        reward, weight, start = term.node["term_name"], float(term.node["weight"]), int(term.node["num_steps"])
        before = float(case.env.rewards[reward]["weight"])
        if weight == before:
            message = f"'{reward}' has the weight {before:g} from the start: the change to {weight:g} has no effect"
            hint = "another weight of the reward or of the curriculum, or no curriculum"
            yield Finding(f"{term.path}.weight", message, hint, {"before": before, "after": weight})
        if start >= total:
            message = f"training takes {total} control steps, and the weight changes after {start}"
            hint = f"num_steps below {total}, or more iterations"
            figures: dict[str, float] = {"num_steps": start, "total_steps": total}
            yield Finding(f"{term.path}.num_steps", message, hint, figures, ({f"{term.path}.num_steps": total - 1},))


@rule
def levels_out_of_reach(case: Case) -> Iterator[Finding]:
    """No robot can reach the higher terrain levels.

    A robot moves to the next terrain level if it ends an episode more than half a terrain tile from its start. In an
    episode of length T, a robot with the largest velocity command v moves by the distance v T. Source: Isaac Lab 2.3.2,
    ``isaaclab_tasks/manager_based/locomotion/velocity/mdp/curriculums.py``, ``terrain_levels_vel``.
    """
    for term in case.terms("curriculum", "curriculums.terrain_levels_vel"):
        size = case.env.scene.terrain.get("size")
        if size is None:
            message = "the ground has no tiles, so the level never changes"
            yield Finding(term.path, message, "scene=rough, another ground of tiles, or no such curriculum")
            continue
        ranges = case.env.commands.get(term.node.get("command_name", "base_velocity"), {}).get("ranges")
        if not isinstance(ranges, Mapping):
            continue
        speed = math.hypot(*(largest(ranges.get(axis)) for axis in ("lin_vel_x", "lin_vel_y")))
        far, half = speed * case.episode_s, float(size[0]) / 2
        if far > half:
            continue
        key, longer = "env.episode_length_s", above(half / speed) if speed else math.inf
        message = f"at {speed:g} m/s a robot moves {far:.3g} m in an episode of {case.episode_s:g} s, "
        message += f"and goes a level up beyond {half:g} m, half a tile"
        hint = f"episodes of {longer:g} s, smaller tiles or faster commands" if speed else "commands that are not zero"
        figures = {"speed_m_s": speed, "way_m": far, "half_tile_m": half}
        yield Finding("env.scene.terrain.size", message, hint, figures, ({key: longer},) if speed else ())
