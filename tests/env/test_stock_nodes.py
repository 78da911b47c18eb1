"""Every node of the stock configs, found by itself: what it gives, that a look changes nothing, and exact resume.

Terms of one group share an environment. Of leg actions, wheel actions, robots, scenes, and solvers it has one each.
"""

from __future__ import annotations

import io
from itertools import cycle, islice
from pathlib import Path

import pytest
import torch
import yaml

from env.composed import composed
from env.crawler import Crawl, differing
from env.test_state import DERIVED as KNOWN
from env.test_state import act, equal
from wheelleg_exp.build import build_env
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.rl.determinism import no_global_draws

pytestmark = pytest.mark.slow

MOUNTS = {
    "command": "env.commands",
    "observation": "env.observations.policy.terms",
    "event": "env.events",
    "reward": "env.rewards",
    "termination": "env.terminations",
    "curriculum": "env.curriculum",
    "sensor": "env.scene.sensors",
    "recorder": "env.recorders",
}
APART = ("action", "realism", "robot", "scene", "sim")
# The environment does not build the nodes of these config groups.
NOT_BUILT = ("agent", "pipeline", "protocol", "recording", "run", "task", "training")
# These options need a terrain of tiles; the values are their config groups.
ON_TILES: dict[str, str] = {"flat_patch": "command", "reset_base_on_terrain": "event"}
# Camera options need a rendering backend; the values are their config groups.
PICTURES: dict[str, str] = {"sensors/camera_image": "observation", "sensors/depth_image": "observation"}
DRAWN = {"camera"}
TOGETHER = [["command", "event"], ["curriculum"], ["observation", "reward"], ["recorder", "sensor", "termination"]]
SIZE = ["env.num_envs=3", "env.sim.nthread=1", "env.episode_length_s=0.2"]
SIZE += ["env.scene.sensors.contact_forces.track_air_time=true"]
# Every sensor recomputes these attributes from the physics results.
DERIVED = KNOWN | {"._readings", "._pressures", "._normals", "._norms", "._largest_norm", "._counts", ".data._history"}
DERIVED |= {
    f".sensors['{name}'].{what}"
    for name in ("height_scanner", "lidar", "camera")
    for what in ("_data", "_outdated", "_pictures")
}
DERIVED |= {".recorder_manager", "reset_order[7]", "._parts['env.recorders']"}  # Recorded data is not state.


def files(group: str) -> list[str]:
    """Return the options of a config group and of the folders below it."""
    folder = configs_dir() / group
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))


GROUPS = sorted(path.name for path in Path(configs_dir()).iterdir() if path.is_dir())


def test_every_group_is_tried_or_named_as_one_that_is_not():
    assert {*GROUPS} <= {*MOUNTS, *APART, *NOT_BUILT}
    assert {group for groups in TOGETHER for group in groups} == {*MOUNTS}


def needs(group: str, options: list[str]) -> dict[str, set[str]]:
    """Return the names of the commands and sensors to which the options of a group refer."""
    found: dict[str, set[str]] = {"command": set(), "sensor": set()}

    def walk(value):
        if isinstance(value, dict):
            name = value.get("name")
            if str(value.get("_target_", "")).endswith("SceneEntityCfg") and name != "robot":
                found["sensor"].add(name)
            if "command_name" in value:
                found["command"].add(value["command_name"])
            for item in value.values():
                walk(item)
        elif isinstance(value, list):
            for item in value:
                walk(item)

    for option in options:
        walk(yaml.safe_load((configs_dir() / group / f"{option}.yaml").read_text()))
    return found


def options_by_key(group: str) -> dict[str, str]:
    """Return the option of a config group that defines each term, by the term's key."""
    options = reversed(files(group))  # The first option that defines a key wins.
    read = {option: yaml.safe_load((configs_dir() / group / f"{option}.yaml").read_text()) for option in options}
    return {key: option for option, node in read.items() for key in node or {}}


def mounting(options: dict[str, list[str]]) -> list[str]:
    """Return the overrides that add options to the stock task, with the commands and sensors to which they refer."""
    wanted = dict(options)
    for group, names in options.items():
        for other, keys in needs(group, names).items():
            known = options_by_key(other)
            wheeled = {f"wheeled/{key}" for key in keys}.intersection(files(other))
            wanted[other] = sorted({*wanted.get(other, []), *(known[key] for key in keys if key in known), *wheeled})
    if "base_velocity" not in wanted["command"]:
        wanted["command"] = ["base_velocity", *wanted["command"]]
    added = ("sensor", "recorder")  # The stock task has no list of these options.
    chosen = {name: ",".join(names) for name, names in wanted.items() if names}
    return [f"{'+' if name in added else ''}{name}@{MOUNTS[name]}=[{names}]" for name, names in chosen.items()]


def built(overrides: list[str]):
    """Return the environment of the stock task with some overrides."""
    found = composed("task=stand", *SIZE, *overrides)
    for reward in found.config["env"]["rewards"].values():
        reward["weight"] = reward["weight"] or 1.0  # The manager does not call a reward of weight 0.
    return build_env(found.config, asset_roots=found.asset_roots)


def hold(overrides: list[str]) -> None:
    """Check every property that each stock config node must have."""
    with no_global_draws():
        env = built(overrides)
        env.reset()
        for _ in range(4):
            act(env, 5)
            given(env)
        looks(env)
    restores(env, overrides)


def given(env) -> None:
    """Check the shapes, dtypes, and values of observations, rewards, and terminations."""
    manager, commands, actions = env.observation_manager, env.command_manager, env.action_manager
    groups = {group: manager.split(group, manager.obs_buf[group]) for group in manager.active_terms}
    numbers = {f"{group}.{name}": value for group, parts in groups.items() for name, value in parts.items()}
    numbers |= {name: commands.get_term(name).command for name in commands.active_terms}
    numbers |= {name: actions.get_term(name).processed_actions for name in actions.active_terms}
    numbers["rewards"] = env.reward_manager.step_reward.T
    for name, value in numbers.items():
        assert (value.shape[0], value.dtype, value.device) == (3, torch.float32, env.device), name
        assert value.isfinite().all(), name
    for term in env.termination_manager.bound_terms:
        assert term(env).dtype == torch.bool, term.name
    assert not any(key == "non_finite" for key in env.extras)


def looks(env) -> None:
    """Check that reading observations and describing the environment change no state."""
    before = Crawl(env, DERIVED)
    first, second = env.observation_manager.peek(), env.observation_manager.peek()
    env.describe()
    env.state_dict()
    assert equal(first, second)
    assert differing(before, Crawl(env, DERIVED)) == []


def restores(env, overrides: list[str]) -> None:
    """Check that a restored environment is bit-identical after the same steps."""
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    other = built(overrides)  # The terrain also depends on the seed.
    other.reset()
    act(other, 3, start=1000)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert differing(Crawl(env, DERIVED | {".cfg"}), Crawl(other, DERIVED | {".cfg"})) == []
    assert equal(act(env, 14, start=50), act(other, 14, start=50))


@pytest.mark.parametrize("groups", TOGETHER, ids=",".join)
def test_all_terms_of_a_group(groups):
    alone = {*ON_TILES, *PICTURES, *DRAWN}
    hold(mounting({group: [option for option in files(group) if option not in alone] for group in groups}))


@pytest.mark.pictures
@pytest.mark.parametrize("option", PICTURES)
def test_what_shows_pictures(option, request):
    needed = mounting({PICTURES[option]: [option]})
    if needs(PICTURES[option], [option])["sensor"] & DRAWN:
        request.getfixturevalue("graphics")
    hold(needed)


def test_what_needs_a_ground_of_tiles():
    ground = "env.scene.terrain.sub_terrains"
    patches = "num_patches: 4, patch_radius: 0.02, max_height_diff: 0.05"
    patches = "{_target_: wheelleg_exp.sim.terrain.FlatPatches, " + patches + "}"
    kinds = yaml.safe_load((configs_dir() / "scene/rough.yaml").read_text())["terrain"]["sub_terrains"]
    others = [f"~{ground}.{kind}" for kind in kinds if kind != "rough"]
    tiles = ["scene=rough", "env.scene.terrain.num_rows=2", "env.scene.terrain.num_cols=2", *others]
    named = [f"+{ground}.rough.flat_patches.{name}={patches}" for name in ("target", "init_pos")]
    hold([*tiles, *named, *mounting({group: [option] for option, group in ON_TILES.items()})])


def combinations() -> list[list[str]]:
    """Return overrides, each with one option of every group in ``APART``; together they have all options."""
    legs = [name for name in files("action") if name.startswith("leg_")]
    groups = [legs, sorted({*files("action")} - {*legs}), *map(files, APART[1:])]
    rows = zip(*(islice(cycle(group), max(map(len, groups))) for group in groups), strict=True)
    return [[f"action@env.actions=[{leg},{wheel}]", *map("{}={}".format, APART[1:], row)] for leg, wheel, *row in rows]


@pytest.mark.parametrize("overrides", combinations(), ids=",".join)
def test_each_option_that_excludes_others(overrides):
    hold(overrides)
