"""Export runs as run folders of Isaac Lab."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from sim.terrain.tiles import placed

from tests.isaaclab_import.runs import AGENT, ENV, ROBOT, write_run, write_terms
from tests.isaaclab_import.test_env_mapping import converted, numbers, with_terrain
from wheelleg_exp.cli.main import main
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env.realism import with_realism
from wheelleg_exp.isaaclab_import.make_project import import_run
from wheelleg_exp.jobs.export.isaaclab_run import OWN_TERMS, RENAMED, TASK_TERMS, TILES, IsaacLabEnv
from wheelleg_exp.plain_data import tagged_yaml_value
from wheelleg_exp.sim.options import read_env
from wheelleg_exp.sim.terrain import PyramidStairs
from wheelleg_exp.terms.config_sections import plain_section

NAMES = yaml.safe_load(Path("docs/tables/isaaclab_names.yaml").read_text())["names"]
NOT_HERE = ("intensity", "scene.robot.spawn", "sim.physx", "sim.physics_material", "rewards.own", "viewer")
NOT_HERE = (*NOT_HERE, "dynamic_friction")


def test_each_number_of_an_isaac_lab_config_comes_back() -> None:
    tree = tagged_yaml_value(ENV)
    mapping, _, _ = converted(ENV, AGENT)
    made = IsaacLabEnv({**mapping.env, "robot": {**mapping.robot, "asset": "robot.usd"}}, mapping.seed or 0)
    assert [note.split(":")[0] for note in made.notes] == ["robot.asset", "sim"]
    compared = 0
    for path in numbers(tree):
        there, here = tree, made.tree
        for key in path:
            there, here = there[key], here.get(key, {}) if isinstance(here, dict) else here[key]
        if there != 0 and not any(name in ".".join(map(str, path)) for name in NOT_HERE):
            assert here == there, path
            compared += 1
    assert compared > 40


def test_terms_without_a_counterpart_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "terms", "--json"]) == 0
    terms = [term["target"] for term in json.loads(capsys.readouterr().out) if term["group"] != "recorder"]
    here = {target.rpartition(".")[2] for target in terms}
    there = {name for section, names in NAMES.items() if section.startswith("mdp.") for name in names}
    assert here - there - TASK_TERMS - RENAMED.keys() == OWN_TERMS
    assert RENAMED.keys() < here - there
    assert here - there > TASK_TERMS
    env = compose(["task=terrain", "realism=full"]).config["env"]
    integrator = {"_target_": "wheelleg_exp.mdp.modifiers.Integrator", "dt": 0.1}
    env["observations"]["policy"]["terms"]["base_ang_vel"]["modifiers"] = [integrator]
    made = IsaacLabEnv(plain_section(with_realism(read_env(env))), 0)
    assert made.tree["observations"]["policy"]["base_ang_vel"]["modifiers"] == []
    for note in (
        "rewards.travel_error: Isaac Lab has no travel_error_l2",
        "observations.policy.base_ang_vel.noise: Isaac Lab has no SensorErrors",
        "actions.leg_pos.delay: Isaac Lab's terms have no delay",
        "scene.terrain.sub_terrains.rough: Isaac Lab has no tile UniformNoise",
    ):
        assert note in made.notes


def test_each_tile_comes_back() -> None:
    tiles: dict[str, dict[str, Any]] = {
        function: {"function": f"mesh_terrains:{function}", "proportion": 0.1} for function in TILES
    }
    tiles["pyramid_sloped_terrain"] |= {"slope_range": [0.1, 0.4], "inverted": True, "platform_width": 1.0}
    tiles["pit_terrain"] |= {"pit_depth_range": [0.1, 0.2], "double_pit": True}
    stairs = {"step_height_range": [0.05, 0.23], "step_width": 0.3, "platform_width": 2.7, "border_width": 1.0}
    tiles["pyramid_stairs_terrain"] |= stairs
    tiles["inverted_pyramid_stairs_terrain"] |= stairs
    tiles["box_terrain"] |= {"box_height_range": [0.1, 0.2], "double_box": False}
    generator = {"size": [8.0, 8.0], "sub_terrains": tiles}
    mapping, _, _ = converted(with_terrain(generator), AGENT)
    made = IsaacLabEnv({**mapping.env, "robot": {**mapping.robot, "asset": "robot.usd"}}, 0)
    found = made.tree["scene"]["terrain"]["terrain_generator"]["sub_terrains"]
    assert [note.split(":")[0].rpartition(".")[2] for note in made.notes if "terrain" in note] == ["gap_depth"]
    for name, tile in tiles.items():
        assert found[name].pop("function").rpartition(":")[2] == name
        expected = {key: value for key, value in tile.items() if key not in ("function", "slope_range")}
        assert {key: value for key, value in found[name].items() if key != "slope_range"} == expected
    assert found["pyramid_sloped_terrain"]["slope_range"] == pytest.approx([0.1, 0.4])
    assert found["pyramid_sloped_terrain"]["inverted"] is True


@pytest.mark.parametrize(("platform", "width"), [(0.0, 0.3), (0.1, 0.3), (0.0, 0.4), (3.0, 0.3)])
def test_exported_stairs_have_the_same_top(platform: float, width: float) -> None:
    settings = {"step_height_range": [0.1, 0.1], "step_width": width, "platform_width": platform}
    ground = placed({"stairs": PyramidStairs(proportion=1.0, **settings)}, size=[8.0, 8.0], num_rows=1, num_cols=1)
    x = torch.arange(0.05, 8.0, 0.1) - 4
    top = ground.height_at(torch.stack([x, torch.zeros_like(x) + 0.05], dim=-1)).max()
    env = converted(ENV, AGENT)[0]
    tiles = {"stairs": {"_target_": "wheelleg_exp.sim.terrain.PyramidStairs", "border_width": 0.0, **settings}}
    terrain = {"_target_": "wheelleg_exp.sim.terrain.TerrainGenerator", "size": [8.0, 8.0], "sub_terrains": tiles}
    scene = {**env.env["scene"], "terrain": {**env.env["scene"]["terrain"], **terrain}}
    made = IsaacLabEnv({**env.env, "scene": scene, "robot": {**env.robot, "asset": "robot.usd"}}, 0)
    tile = made.tree["scene"]["terrain"]["terrain_generator"]["sub_terrains"]["stairs"]
    inner = 8 - 2 * tile["border_width"]
    rings = (inner - tile["platform_width"]) // (2 * width) + 1  # of Isaac Lab, which raises the middle by one more
    assert (rings + 1) * 0.1 == pytest.approx(float(top), abs=1e-4)
    assert min(tile["platform_width"], inner - 2 * rings * width) > 0


def test_an_exported_run_is_imported_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(tmp_path / "run")
    write_terms(tmp_path / "lab")
    monkeypatch.chdir(tmp_path)
    import_run(Path("run"), ROBOT, Path("flip6"), terms=Path("lab"))
    monkeypatch.chdir(tmp_path / "flip6")
    assert main(["export", "latest", "--format", "isaaclab", "-o", str(tmp_path / "lab_run")]) == 0
    monkeypatch.chdir(tmp_path)
    import_run(Path("lab_run"), ROBOT, Path("flip7"), terms=Path("flip6"))
    first = Path("flip6/configs/task/flip6.yaml").read_text().replace("flip6", "flip7")
    second = Path("flip7/configs/task/flip7.yaml").read_text()
    assert {**yaml.safe_load(first)["env"], "num_envs": 16} == yaml.safe_load(second)["env"]


@pytest.mark.parametrize("name", ["walk", "terrain"])
def test_a_stock_policy_is_imported_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["export", f"stock:{name}", "--format", "isaaclab", "-o", "lab_run"]) == 0
    made = import_run(Path("lab_run"), ROBOT, Path("flip8"))
    exported, again = (
        torch.jit.load(p) for p in ("lab_run/exported/policy.pt", next(made.path.rglob("exported/*.pt")))
    )
    x = torch.randn(4, next(exported.parameters()).shape[1])
    torch.testing.assert_close(again(x), exported(x), atol=1e-5, rtol=1e-5)
