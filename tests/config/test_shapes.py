import json
from itertools import cycle

import pytest
from patience import thinned

from wheelleg_exp.cli.configs.compose import shapes
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.paths import configs_dir

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
VARIANTS = {
    "as it is": [],
    "no history, and history that is not flattened": [
        "env.observations.policy.history_length=0",
        "env.observations.critic.flatten_history_dim=false",
    ],
    "terms that are not joined, and others": [
        "env.observations.policy.concatenate_terms=false",
        "observation@env.observations.critic.terms=[last_action,base_lin_vel]",
        "+env.observations.critic.terms.angles={_target_: wheelleg_exp.mdp.observations.joint_pos_sin_cos}",
        "action@env.actions=[leg_pos,wheel_rel_pos]",
    ],
}


@pytest.mark.parametrize(("task", "variant"), thinned(zip(TASKS, cycle(VARIANTS), strict=False), 2))
def test_the_layout_is_that_of_the_built_environments_tensors(task, variant):
    from wheelleg_exp.build import build_env

    words = [f"task={task}", "env.num_envs=3", *VARIANTS[variant]]
    composed = compose(words)
    found = shapes(composed)
    env = build_env(composed.config)
    observations, _ = env.reset()
    assert list(found.observations) == list(observations)
    for name, group in found.observations.items():
        value = observations[name]
        if isinstance(value, dict):
            assert group.shape is None
            shapes_of_terms = {term.name: (3, *term.shape) for term in group.terms}
            assert shapes_of_terms == {name: tuple(tensor.shape) for name, tensor in value.items()}
        else:
            assert group.shape is not None
            assert (3, *group.shape) == tuple(value.shape)
            slices = env.observation_manager.term_slices(name).values()
            assert [(t.start, t.stop) for t in group.terms] == [(s.start, s.stop) for s in slices]
    assert found.actions.shape == (env.action_manager.total_action_dim,)
    env.action_manager.process_action(env.action_manager.action.new_zeros(3, *found.actions.shape))


def test_the_layout_of_the_main_task_by_hand_and_without_a_step(monkeypatch):
    from wheelleg_exp.sim.batch_engine import BatchEngine

    def step(self):
        raise AssertionError("a physics step")

    monkeypatch.setattr(BatchEngine, "step", step)
    found = shapes(compose(["task=stand", "env.num_envs=1000000"]))
    widths = {name: [(t.name, t.width, t.history) for t in g.terms] for name, g in found.observations.items()}
    policy = [(name, 3, 5) for name in ("base_ang_vel", "projected_gravity", "velocity_commands")]
    policy += [("joint_pos_rel", 4, 5), ("joint_vel_rel", 6, 5), ("last_action", 6, 5)]
    travel = ("travel_error", 2, 5)
    critic = [*policy, ("base_lin_vel", 3, 5), ("joint_effort", 6, 5), travel]
    assert widths == {"policy": [*policy, travel], "critic": critic}
    assert {name: group.shape for name, group in found.observations.items()} == {"policy": (135,), "critic": (180,)}
    assert [(t.name, t.width, t.joints) for t in found.actions.terms] == [
        ("leg_pos", 4, ("l01", "l02", "r01", "r02")),
        ("wheel_vel", 2, ("l03", "r03")),
    ]


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("env.actions.leg_pos.joint_names=[l01,l09]", ("env.actions.leg_pos.joint_names", "l09")),
        ("--provenance", ("--shapes",)),
    ],
)
def test_a_missing_joint_and_a_second_kind_of_output_are_refused(word, expected, capsys):
    assert main(["compose", "--shapes", word]) == 2
    message = capsys.readouterr().err
    assert [part for part in expected if part not in message] == []


def test_the_command_prints_tables_or_json(capsys):
    assert main(["compose", "--shapes", "task=stand"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["observations.policy:", "135"] in lines
    assert ["joint_pos_rel", "joint_pos_rel", "4", "5", "20", "45..64"] in lines
    assert ["wheel_vel", "JointVelocityAction", "2", "4..5", "l03", "r03"] in lines
    assert main(["compose", "--shapes", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["observations"]["critic"]["shape"], found["actions"]["terms"]["leg_pos"]["width"]) == ([180], 4)
