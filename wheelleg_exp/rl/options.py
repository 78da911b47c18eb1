"""Keys of the ``agent`` section: those of the trainer, and valid values of rsl_rl's parameters."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Count, Natural, NonNegative, NotEmpty, Parameters, Positive, Rising
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.terms.config_sections import plain_section, read_section
from wheelleg_exp.terms.config_values import value_errors
from wheelleg_exp.terms.key_syntax import below
from wheelleg_exp.terms.term_binding import walk_nodes

Matmul = Literal["auto", "float32", "bfloat16", "tf32"]


@dataclass(frozen=True)
class SymmetryOptions:
    r"""``agent.symmetry``: how the robot is mirrored, for ``wheelleg_exp.rl.symmetry.left_right`` and mirrored robots.

    Attributes:
        joint_pairs: expressions that match the full names of joints on one side, and the names of their images on the
            other side, with `\1` for a matched group. A joint without a pair is its own mirror image. The value null in
            ``joint_pairs`` removes a pair of joints. They are added to ``env.robot.joint_pairs``; a robot without any
            is not symmetric, and its policy learns without mirror images.
        terms: mirror rules of user-defined observations: a rule by the name of the term, or a sign for each number.
        mirrored_envs: whether the policy sees every second environment in a mirror during training (observations and
            actions), so that it learns both sides from the same number of samples.
    """

    joint_pairs: dict[str, str | None]
    terms: dict[str, str | Sequence[float]] = field(default_factory=dict)
    mirrored_envs: bool = False


@dataclass(frozen=True)
class InitialKl:
    """``agent.initial_kl``: a loss that keeps the policy near the policy of ``init_from``.

    Attributes:
        weight: factor on the mean Kullback-Leibler divergence KL(policy || initial policy), in nats.
        except_while: name of an observation of a network. The loss of a sample is 0 while a value of the observation is
            not 0. null means that the loss includes all samples.
    """

    weight: NonNegative
    except_while: str | None = None


@dataclass(frozen=True, kw_only=True)
class Learning:
    """``agent``: what every algorithm of rsl_rl and the trainer read.

    Attributes:
        max_non_finite: share of the environments whose episode may end in one iteration because a number was NaN or
            inf; one episode is always allowed. ``max_non_finite`` can stop a training, but never changes the policy.
        matmul: precision of matrix products in the update: `float32`, `bfloat16` (on CPUs; weights and sums stay
            float32), `tf32` (on GPUs: factors have 10 bits), or `auto`: bfloat16 if the CPU has units for it, tf32 on a
            GPU. Acting always uses float32.
        graph_update: whether PPO's acting and update are CUDA graphs on a GPU. rsl_rl itself updates PPO with RND,
            mirrored samples, or recurrent networks.
        average_iterations: number of iterations over which the policy's weights are averaged exponentially; 0 means no
            average. The averaged policy weights are used to play, evaluate, export, and start other trainings. Policy
            updates change a policy's current weights, not the averaged weights.
    """

    roles: ClassVar[tuple[str, ...]]  # the networks: first the policy, then the network that helps to train it

    algorithm: Parameters
    num_steps_per_env: Count
    max_iterations: Count
    save_interval: Count
    obs_groups: dict[str, list[str]]
    device: str
    torch_threads: Annotated[int, constraints.AtLeast(1), constraints.AtMost(1024)]
    clip_actions: Positive | None = None
    logger: Literal["tensorboard", "wandb"] | None = "tensorboard"
    torch_compile_mode: str | None = None
    max_non_finite: NonNegative = 0.1
    matmul: Matmul = "float32"
    graph_update: bool = False
    average_iterations: Natural = 0

    @property
    def networks(self) -> dict[str, Parameters]:
        """The options of each network."""
        return {role: getattr(self, role) for role in self.roles}

    @staticmethod
    def of_section(agent: Mapping[str, object]) -> type[Learning]:
        """Return the dataclass of the config section ``agent``, which depends on the class of the rsl_rl algorithm."""
        algorithm = agent.get("algorithm")
        name = str(algorithm.get("class_name")) if isinstance(algorithm, Mapping) else ""
        return DistillationAgent if re.split("[.:]", name)[-1] == "Distillation" else Agent


@dataclass(frozen=True, kw_only=True)
class Agent(Learning):
    """``agent`` of reinforcement learning: an actor and its critic.

    Attributes:
        warm_start: number of rollouts before the first iteration in which the actor learns the actions of the reference
            controller. A training with ``init_from`` has none.
        warm_critic: number of first iterations in which only the critic learns, at the learning rate 0.001. They do not
            change the policy, its exploration noise, or its observation normalisation. Afterwards, the actor learns at
            ``algorithm.learning_rate``, which must be small for a trained policy with little noise.
        initial_kl: a loss that keeps the policy near its initial policy; null means no such loss.
    """

    roles: ClassVar = ("actor", "critic")

    actor: Parameters
    critic: Parameters
    symmetry: SymmetryOptions | None = None
    warm_start: Natural = 0
    warm_critic: Natural = 0
    initial_kl: InitialKl | None = None


@dataclass(frozen=True, kw_only=True)
class DistillationAgent(Learning):
    """``agent`` of distillation: a student that learns to answer as its teacher does.

    Attributes:
        teacher_checkpoint: whose actor teaches: a checkpoint's path, or a run by path, id or `latest`, whose last
            checkpoint it is. The run keeps a copy.
    """

    roles: ClassVar = ("student", "teacher")

    student: Parameters
    teacher: Parameters
    teacher_checkpoint: Annotated[str, NotEmpty()]


# rsl_rl accepts invalid values, so each key in ``PARAMETERS`` is checked wherever it occurs in the section `agent`.
PARAMETERS: dict[str, object] = {
    "num_learning_epochs": Count,
    "num_mini_batches": Count,
    "clip_param": Positive,
    "gamma": constraints.Share,
    "lam": constraints.Share,
    "value_loss_coef": NonNegative,
    "entropy_coef": NonNegative,
    "learning_rate": Positive,
    "max_grad_norm": Annotated[float, constraints.Above(0), constraints.MayBeInfinite()] | None,
    "schedule": Literal["fixed", "adaptive"],
    "desired_kl": Positive | None,
    "grad_reduce_bucket_mb": Positive,
    "gradient_length": Count,
    "loss_type": Literal["mse", "huber"],
    "mirror_loss_coeff": NonNegative,
    "num_outputs": Count,
    "hidden_dims": Annotated[Sequence[Count], NotEmpty()],
    "rnn_type": Literal["lstm", "gru"],
    "rnn_hidden_dim": Count,
    "rnn_num_layers": Count,
    "init_std": Positive,
    "std_range": Annotated[Sequence[Positive], Rising()],
    "std_type": Literal["scalar", "log"],
    "action_range": Annotated[Sequence[float], Rising()],
}


def read_agent(agent: Mapping[str, object]) -> Learning:
    """Return the config section ``agent`` as options; raise ConfigError at the first mistake."""
    return read_section(Learning.of_section(agent), agent, "agent")


def require_agent(agent: Learning, num_envs: int) -> None:
    """Raise ConfigError for the first invalid parameter of rsl_rl, and for too few samples."""
    for error in (*parameter_errors(plain_section(agent)), *batch_errors(agent, num_envs)):
        raise error


def parameter_errors(agent: Mapping[str, object]) -> Iterator[ConfigError]:
    """Yield an error for each invalid value of rsl_rl's parameters."""
    for path, node in walk_nodes({name: section for name, section in agent.items() if name != "obs_groups"}, "agent"):
        for name, value in node.items():
            if name in PARAMETERS and path != "agent":
                yield from value_errors(below(path, name), value, PARAMETERS[name])


def batch_errors(agent: Learning, num_envs: int) -> Iterator[ConfigError]:
    """Yield an error if a training iteration has less than two samples, or fewer samples than minibatches."""
    samples = num_envs * agent.num_steps_per_env
    if samples < 2:  # PPO divides advantages by their standard deviation, which needs two samples.
        message, expected = f"{samples} sample is too little to learn from", "at least 2 samples, env.num_envs times it"
        yield ConfigError(message, key="agent.num_steps_per_env", expected=expected)
    elif agent.algorithm.get("num_mini_batches", 1) > samples:
        expected = f"at most {samples}, env.num_envs times agent.num_steps_per_env"
        message, key = "there are fewer samples than minibatches", "agent.algorithm.num_mini_batches"
        yield ConfigError(message, key=key, expected=expected)
