"""Compare the replayed sources of every stock task with the config of Hydra's compose API."""

from itertools import cycle

import pytest
import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from omegaconf import OmegaConf, open_dict
from patience import thinned
from small_tree import replayed

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.tree_lookup import leaves
from wheelleg_exp.paths import configs_dir

pytestmark = pytest.mark.slow

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
PRIMARIES = sorted(path.stem for path in configs_dir().glob("*.yaml"))

# Each kind of Hydra override, alone and in combination.
RECIPES = {
    "leaves": [
        "env.rewards.lin_vel_z.weight=-30", "env.rewards.lin_vel_z.weight=-20", "+env.actions.leg_pos.offset=0.5",
        "++env.rewards.lin_vel_z.extra={deep: {er: 1}}", "hydra.searchpath=[]",
    ],
    "lists and nulled terms": [
        "env.robot.joint_order.1=z", "env.sim.gravity=[0,0,-1]", "recording.env_ids=[]",
        "env.events.push_robot=null", "env.rewards.lin_vel_z=null", "env.rewards.lin_vel_z={weight: 3}",
    ],
    "keys with dots, interpolations, and new terms": [
        "++env.robot.init_state.joint_pos={left.04: 0.5}", "env.decimation=${seed}", "seed=${env.sim.nthread}",
        "+env.rewards.empty={}", "++env.rewards.lin_vel_z={}",
        "+env.rewards.mine={_target_: wheelleg_exp.mdp.rewards.is_alive, weight: 2}",
        "+reward@env.rewards=[action_rate,joint_torques]",
    ],
    "other lists of terms": [
        "reward@env.rewards=[terminating,lin_vel_z]", "action@env.actions=[wheel_vel,leg_pos]", "event@env.events=[]",
    ],
    "deleted terms and leaves": ["~env.events.push_robot", "~env.rewards.lin_vel_z.weight", "~env.decimation=2"],
    "deleted and added": [
        "~env.rewards.lin_vel_z",
        "+env.rewards.lin_vel_z={_target_: wheelleg_exp.mdp.rewards.lin_vel_z_l2}",
        *(f"~env.terminations.{name}" for name in ("time_out", "non_finite_state")),
    ],
    "another option, a leaf of it, no group": ["robot=physical", "env.robot.actuators.legs.armature=0.1", "~run"],
    "options that extend others": ["robot=explicit", "sim=fine", "env.decimation=8"],
}  # fmt: skip


def _of_hydra(primary: str, overrides: list[str]) -> dict:
    with initialize_config_dir(str(configs_dir()), version_base="1.3"):
        config = hydra_compose(primary, overrides, return_hydra_config=True)
    with open_dict(config):
        del config["hydra"]
    return OmegaConf.to_container(config, resolve=False)


# The effect of an override does not depend on the task, so each override is tested with only one task.
@pytest.mark.parametrize(("task", "recipe"), zip(cycle(TASKS), RECIPES, strict=False))
def test_every_leaf_of_a_task_is_hydras_in_value_and_order(task, recipe):
    words = [f"task={task}", *RECIPES[recipe]]
    wanted, ours = _of_hydra("train", words), replayed(compose_raw(words))
    assert dict(leaves(ours)) == dict(leaves(wanted))
    assert _orders(ours) == _orders(wanted)


@pytest.mark.parametrize("primary", PRIMARIES)
def test_every_leaf_of_a_primary_is_hydras(primary):
    alone = _of_hydra(primary, [])
    assert replayed(compose_raw([], primary)) == alone
    words = ["seed=9", "recording.env_ids=[1,2]", "+recording.extra=${seed}"]
    kept = [word for word in words if word.split("=")[0].strip("+").split(".")[0] in alone]
    words = kept or ["pipeline.name=other", "+pipeline.extra=${pipeline.name}"]
    assert replayed(compose_raw(words, primary)) == _of_hydra(primary, words)


@pytest.mark.parametrize("task", thinned(TASKS, 3))
def test_the_line_of_a_leaf_contains_its_value(task):
    places = compose_raw([f"task={task}"])
    assert configs_dir() / "reward" / "lin_vel_z.yaml" in {source.file for source in places.values()}
    for path, source in places.items():
        line = source.file.read_text(encoding="utf-8").splitlines()[source.line - 1]
        assert path.removesuffix("]").rsplit(".", 1)[-1] in line or f'"{path.rsplit("[", 1)[-1][:-1]}"' in line
        if "{" not in line and line.split("#")[0].strip()[-1] != ":":
            assert next(iter(yaml.safe_load(line.strip()).values())) == source.value


def compose_raw(words, primary="train"):
    return compose(words, primary=primary).provenance


def _orders(node) -> list:
    return [] if not isinstance(node, dict) else [list(node), *(_orders(child) for child in node.values())]
