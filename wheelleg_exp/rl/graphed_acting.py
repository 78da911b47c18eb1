"""What rsl_rl's PPO computes before each step of a rollout, as one CUDA graph in place of some fifty launches."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.modules.distribution import GaussianDistribution


def can_act(algorithm: Any) -> bool:
    """Return whether an algorithm, whose update is one of graphs, draws actions from normal distributions."""
    return getattr(type(algorithm.actor.distribution), "sample", None) is GaussianDistribution.sample


class GraphedActing:
    """Acts as ``PPO.act`` does: draws actions, and notes what the update needs of them.

    The first rollout acts by rsl_rl's own method; a graph is captured at the beginning of a rollout, and anew when
    the networks lie in other memory.

    Args:
        algorithm: the algorithm, on a GPU, with networks that are not recurrent.
    """

    def __init__(self, algorithm: PPO) -> None:
        self._algorithm = algorithm
        self._graph: Any = None
        self._captured: tuple[int, ...] = ()
        self._observations: Any = None
        self._found: dict[str, Any] = {}
        self._acted = False

    def __call__(self, observations: Any) -> torch.Tensor:
        """Return actions (N, A) for observations by group."""
        algorithm = self._algorithm
        if algorithm.storage.step == 0:
            if self._acted and self._captured != self._memory():
                self._capture(observations)
            self._acted = True
        if self._graph is None:
            return algorithm.act(observations)
        for group, values in self._observations.items():
            values.copy_(observations[group])
        self._graph.replay()
        transition, found = algorithm.transition, self._found
        transition.hidden_states = (None, None)
        transition.actions = found["actions"].clone()  # whoever keeps them shall keep these
        for name in ("values", "actions_log_prob", "distribution_params"):
            setattr(transition, name, found[name])
        transition.observations = observations
        return transition.actions

    def _capture(self, observations: Any) -> None:
        """Record acting; nothing is drawn."""
        self._observations = observations.clone()
        torch.cuda.synchronize()
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
            self._found = self._computed()
        self._captured = self._memory()

    def _computed(self) -> dict[str, Any]:
        """Return what ``PPO.act`` notes; drawn without torch's look at deviations, which waits for the GPU."""
        actor, observations = self._algorithm.actor, self._observations
        actor.distribution.update(actor.mlp(actor.get_latent(observations)))
        mean, deviation = actor.output_mean, actor.output_std
        actions = mean + deviation * torch.randn_like(mean)
        return {
            "actions": actions,
            "values": self._algorithm.critic(observations),
            "actions_log_prob": actor.get_output_log_prob(actions),
            "distribution_params": tuple(actor.output_distribution_params),
        }

    def _memory(self) -> tuple[int, ...]:
        networks = (self._algorithm.actor, self._algorithm.critic)
        return tuple(v.data_ptr() for network in networks for v in (*network.parameters(), *network.buffers()))
