import pytest
import torch

from sim.small_envs import run
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.terrain import Plane, TerrainBase

pytestmark = pytest.mark.usefixtures("allow_test_terms")
STEP = {"_target_": "managers.spies.Step", "height": 0.4, "static_friction": 0.7, "dynamic_friction": 0.5}
STEP["restitution"] = 0.0


def test_environments_start_on_the_ground_with_the_mean_friction_of_robot_and_ground(start_env):
    env = start_env("block", scene={"terrain": STEP})
    ground, model = env.scene["terrain"], env.scene.model
    assert env.scene.env_origins is ground.env_origins
    assert env.scene.env_origins.tolist() == [[5.0, 0.0, pytest.approx(0.4)], [0, 0, 0]] * 2
    heights = ground.height_at(torch.tensor([[[5.0, 0.0], [5.9, -0.9]], [[3.9, 0.0], [-2.0, 0.0]]]))
    torch.testing.assert_close(heights, torch.tensor([[0.4, 0.4], [0.0, 0.0]]))
    run(env, 60)
    height = env.scene.robot.data.root_pos_w[:, 2]
    torch.testing.assert_close(height[::2] - height[1::2], torch.full((2,), 0.4), atol=2e-3, rtol=0)
    assert float(model.geom("cube").friction[0]) == pytest.approx((0.8 + 0.7) / 2)
    assert {int(model.geom(name).priority[0]) for name in ("ground", "ground/step")} == {0}


def test_a_wrong_ground_is_rejected(make_env):
    with pytest.raises(ConfigError, match=r"env\.scene\.terrain: 'Altimeter' is not a TerrainBase"):
        make_env(scene={"terrain": {"_target_": "managers.spies.Altimeter"}})
    with pytest.raises(ConfigError, match=r"env\.scene\.terrain.*static_friction"):
        make_env(scene={"terrain": {**STEP, "static_friction": -1.0}})


class Tiles(TerrainBase):
    """A ground of four rows and three columns of tiles, with each origin at x = row, y = column."""

    def __init__(self, highest: int | None = None) -> None:
        super().__init__(0.5, 0.5, 0.0)
        self.max_init_terrain_level = highest
        rows, cols = torch.meshgrid(torch.arange(4.0), torch.arange(3.0), indexing="ij")
        self.terrain_origins = torch.stack((rows, cols, 10 * rows), dim=-1)


def placed(ground: TerrainBase, num_envs: int, seed: int = 0) -> TerrainBase:
    generator = torch.Generator().manual_seed(seed)
    ground.place(num_envs, 2.0, torch.device("cpu"), lambda: generator)
    return ground


def test_on_a_plane_all_origins_stay():
    ground = placed(Plane(0.5, 0.5, 0.0), 4)
    before = ground.env_origins.clone()
    ground.update_env_origins(torch.arange(4), torch.ones(4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool))
    assert torch.equal(ground.env_origins, before)
    assert ground.terrain_origins is None
    assert not hasattr(ground, "terrain_levels")  # Terms for Isaac Lab ask this to find out whether there are tiles.
    assert (ground.height_at(torch.rand(2, 5, 2)).tolist(), ground.state_dict()) == ([[0.0] * 5] * 2, {})


def test_rows_are_drawn_up_to_the_highest():
    ground = placed(Tiles(highest=2), 600)
    counts = torch.bincount(ground.terrain_levels, minlength=4)
    assert counts[3] == 0
    assert (counts[:3] > 150).all()
    assert torch.equal(ground.env_origins[:, :2], torch.stack((ground.terrain_levels, ground.terrain_types), 1).float())
    assert placed(Tiles(), 600).terrain_levels.max() == placed(Tiles(highest=9), 600).terrain_levels.max() == 3


@pytest.mark.parametrize("num_envs", [1, 2, 3, 7, 10, 64])
def test_columns_are_isaac_labs(num_envs):
    expected = torch.div(torch.arange(num_envs), num_envs / 3, rounding_mode="floor").long()
    assert torch.equal(placed(Tiles(), num_envs).terrain_types, expected)


def test_levels_go_up_and_down_and_from_the_last_anywhere():
    ground = placed(Tiles(), 400)
    ground.terrain_levels[:] = torch.tensor([0, 1, 2, 3]).repeat(100)
    origins, none, every = ground.env_origins, torch.zeros(400, dtype=torch.bool), torch.ones(400, dtype=torch.bool)
    for up, down, levels in ((none, every, [0, 0, 1, 2]), (every, none, [1, 1, 2, 3])):
        ground.update_env_origins(torch.arange(400), up, down)
        assert ground.terrain_levels[:4].tolist() == levels
    ground.update_env_origins(torch.arange(3, 400, 4), every[:100], none[:100])
    assert sorted(set(ground.terrain_levels[3::4].tolist())) == [0, 1, 2, 3]
    assert ground.terrain_levels[:3].tolist() == [1, 1, 2]
    assert origins is ground.env_origins
    expected = torch.stack((ground.terrain_levels, ground.terrain_types, 10 * ground.terrain_levels), dim=1)
    assert torch.equal(ground.env_origins, expected.float())
