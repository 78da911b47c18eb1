"""Training with rsl_rl's PPO: one iteration is a rollout and an update."""

from __future__ import annotations

import copy
import io
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any, NoReturn

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure, nearest_name
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.projects import make_classes_importable
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.algorithm_state import load_unsaved_state, unsaved_state
from wheelleg_exp.rl.checkpoint import FORMAT_VERSION
from wheelleg_exp.rl.episode_log import EpisodeLog
from wheelleg_exp.rl.global_draws import no_global_draws
from wheelleg_exp.rl.one_thread import one_thread
from wheelleg_exp.rl.vec_env import RslRlVecEnv

# Keys of the agent section that are this program's, not rsl_rl's.
OWN_KEYS = ("device", "torch_threads", "max_iterations", "save_interval", "clip_actions", "logger")


@dataclass(frozen=True)
class Iteration:
    """What one iteration did.

    Attributes:
        index: its number, from 0.
        scalars: what is logged, by rsl_rl's and Isaac Lab's keys.
        env_steps: environment steps of the rollout.
    """

    index: int
    scalars: dict[str, float]
    env_steps: int


class Trainer:
    """Trains a policy.

    The policy's own draws (initial weights, exploration, minibatches) come from torch's global generator, which
    nothing in the environment uses.

    Args:
        env: the adapted environment.
        agent: the composed ``agent`` section, plain.
        seed: the run's seed.

    Raises:
        ConfigError: rsl_rl refuses the section.
    """

    def __init__(self, env: RslRlVecEnv, agent: Mapping[str, Any], seed: int) -> None:
        self.env = env
        self.device = str(agent["device"])
        self.num_steps = int(agent["num_steps_per_env"])
        self.iteration = 0
        torch.manual_seed(stream_seed(seed, "agent"))
        self.algorithm = build_algorithm(env, agent)
        self.log = EpisodeLog(env.num_envs)

    def learn(self, until: int) -> Iterator[Iteration]:
        """Train up to ``until`` iterations in total; yields after each, when everything is whole.

        Raises:
            SimulationFailure: an observation, a reward or a loss is not finite.
        """
        self.algorithm.train_mode()
        while self.iteration < until:
            start = time.perf_counter()
            with no_global_draws("numpy", "python"):
                self._collect()
            collected = time.perf_counter()
            losses = self.algorithm.update()
            self._require_sane(losses)
            learned = time.perf_counter()
            scalars = self.log.collect()
            scalars |= {f"Loss/{name}": float(value) for name, value in losses.items()}
            scalars["Loss/learning_rate"] = float(self.algorithm.learning_rate)
            scalars["Policy/mean_std"] = self.algorithm.get_policy().output_std.mean().item()
            steps = self.num_steps * self.env.num_envs
            scalars["Perf/total_fps"] = steps / (learned - start)
            scalars["Perf/collection_time"] = collected - start
            scalars["Perf/learning_time"] = learned - collected
            done = Iteration(self.iteration, scalars, steps)
            self.iteration += 1
            yield done

    @torch.inference_mode()
    def _collect(self) -> None:
        """Roll the policy out and compute returns."""
        observations = self.env.get_observations().to(self.device)
        for _ in range(self.num_steps):
            actions = self.algorithm.act(observations)
            with no_global_draws("torch"):
                observations, rewards, dones, extras = self.env.step(actions.to("cpu"))
            self._require_finite(observations, rewards)
            self.log.step(rewards, dones, extras)
            observations, rewards, dones = (x.to(self.device) for x in (observations, rewards, dones))
            self.algorithm.process_env_step(observations, rewards, dones, extras)
        with one_thread():
            self.algorithm.compute_returns(observations)

    def _require_finite(self, observations: TensorDict, rewards: torch.Tensor) -> None:
        bad = [f"observation group '{g}'" for g, value in observations.items() if not value.isfinite().all()]
        if not rewards.isfinite().all():
            bad.append("rewards")
        if bad:
            self._fail(f"{' and '.join(bad)} went to NaN or infinity")

    def _require_sane(self, losses: Mapping[str, float]) -> None:
        parameters = [*self.algorithm.actor.parameters(), *self.algorithm.critic.parameters()]
        if not all(math.isfinite(value) for value in losses.values()):
            self._fail("a loss went to NaN or infinity")
        if not all(bool(parameter.isfinite().all()) for parameter in parameters):
            self._fail("the networks' parameters went to NaN or infinity")

    def _fail(self, message: str) -> NoReturn:
        raise SimulationFailure(f"{message} in iteration {self.iteration}", expected="finite numbers")

    def state_dict(self) -> dict[str, Any]:
        """Return everything that the coming iterations depend on; ``iter`` is the last finished iteration."""
        return {
            "format_version": FORMAT_VERSION,
            "iter": self.iteration - 1,
            "infos": None,
            **self.algorithm.save(),
            "unsaved": unsaved_state(self.algorithm),
            "env": self.env.env.state_dict(),
            "log": self.log.state_dict(),
            "rng": self._random_state(),
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned; the random state comes last, because building draws.

        Raises:
            RunDirectoryError: it is the state of other networks, or of another environment.
        """
        checkpoint.require_resumable(saved)
        try:
            self.algorithm.load(dict(saved), None, True)
            load_unsaved_state(self.algorithm, saved["unsaved"])
            self.env.env.load_state_dict(saved["env"])
            self.log.load_state_dict(saved["log"])
        except (RuntimeError, LookupError, ValueError, TypeError, AttributeError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RunDirectoryError(
                f"the saved state does not fit: {reason[:200]}",
                expected="the state of the same networks, terms, robot and number of environments",
            ) from error
        self.iteration = saved["iter"] + 1
        torch.set_rng_state(saved["rng"]["torch"])
        if "device" in saved["rng"]:
            torch.get_device_module(self.device).set_rng_state(saved["rng"]["device"], self.device)

    def set_learning_rate(self, value: float) -> None:
        """Set the learning rate of the coming updates; an adaptive schedule goes on from it."""
        self.algorithm.learning_rate = value
        for group in self.algorithm.optimizer.param_groups:
            group["lr"] = value

    def _random_state(self) -> dict[str, torch.Tensor]:
        state = {"torch": torch.get_rng_state()}
        if torch.device(self.device).type not in ("cpu", "meta"):
            state["device"] = torch.get_device_module(self.device).get_rng_state(self.device)
        return state


def build_algorithm(env: RslRlVecEnv, agent: Mapping[str, Any]) -> PPO:
    """Build rsl_rl's algorithm from the ``agent`` section.

    Raises:
        ConfigError: an observation group is missing, or rsl_rl refuses a value.
    """
    observations = env.get_observations()
    for role, groups in agent["obs_groups"].items():
        for group in groups:
            if group not in observations:
                raise ConfigError(
                    f"there is no observation group '{group}'",
                    key=f"agent.obs_groups.{role}",
                    expected="some of " + ", ".join(observations.keys()),
                    nearest=nearest_name(group, observations.keys()),
                )
            if not isinstance(observations[group], torch.Tensor) or observations[group].ndim != 2:
                raise ConfigError(
                    "a network takes one flat vector a group",
                    key=f"env.observations.{group}",
                    expected="concatenate_terms: true and flatten_history_dim: true",
                )
    if env.num_actions == 0:
        raise ConfigError("there are no actions to learn", key="env.actions", expected="at least one action term")
    _require_device(str(agent["device"]))
    samples = env.num_envs * int(agent["num_steps_per_env"])
    if agent["algorithm"].get("num_mini_batches", 1) > samples:
        raise ConfigError(
            "there are fewer samples than minibatches",
            key="agent.algorithm.num_mini_batches",
            expected=f"at most {samples}, env.num_envs times agent.num_steps_per_env",
        )
    # rsl_rl changes the dictionary that it is given, and prints the networks.
    config = copy.deepcopy({key: value for key, value in agent.items() if key not in OWN_KEYS})
    config["multi_gpu"] = None
    make_classes_importable(config)
    try:
        with redirect_stdout(io.StringIO()):
            kind = resolve_callable(config["algorithm"]["class_name"])
            return kind.construct_algorithm(observations, env, config, str(agent["device"]))
    except (TypeError, ValueError, LookupError, AttributeError, ImportError) as error:
        raise ConfigError(
            f"rsl_rl refuses it: {str(error).splitlines()[0]}",
            key="agent",
            expected="rsl_rl's own configuration",
        ) from error


def _require_device(name: str) -> None:
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(
            f"torch cannot use '{name}': {str(error).splitlines()[0]}",
            key="agent.device",
            expected="cpu, or a device that this torch and this machine have",
        ) from error
