import mujoco
import pytest
import torch

from wheelleg_exp.sim.batch_engine import BatchEngine

GROUND = """
  <geom name="ground" type="plane" size="0 0 .1"/>
  <geom name="ground/step" type="box" size=".5 .5 .2" pos="1 0 .2" euler="0 10 20"/>
  <geom name="ground/ball" type="sphere" size=".3" pos="-1 .4 .1"/>"""
ROBOT = (
    """<body name="block" pos="0 0 .5"><freejoint/><geom name="cube" group="1" type="box" size=".1 .1 .1"/></body>"""
)


def model(*parts):
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(parts)}</worldbody></mujoco>")


@pytest.fixture
def engines():
    whole, apart = (BatchEngine(model(GROUND, ROBOT), 5, 2) for _ in range(2))
    made = []
    apart.cast_alone(0, lambda: made.append(model(GROUND)) or made[-1])
    apart.made = made
    return whole, apart


def rays(count=37):
    generator = torch.Generator().manual_seed(1)
    origins = 2.0 * torch.rand(5, count, 3, generator=generator) - torch.tensor([1.0, 1.0, -0.3])
    return origins, torch.randn(5, count, 3, generator=generator) - torch.tensor([0.0, 0.0, 0.5])


def test_separately_cast_rays_have_bitwise_the_same_length(engines):
    whole, apart = engines
    far = whole.ray(*rays(), (0,))
    assert torch.equal(apart.ray(*rays(), (0,)), far)
    assert len(apart.made) == 1
    assert 0.2 < float((far < 0).float().mean()) < 0.8
    ids = torch.tensor([3, 1])
    assert torch.equal(apart.ray(*[part[ids] for part in rays()], (0,), ids), far[ids])
    assert apart.ray(*(part[:0] for part in rays()), (0,), ids[:0]).shape == (0, 37)


def test_rays_that_can_meet_the_robot_are_cast_in_its_own_simulation(engines):
    whole, apart = engines
    for engine in engines:
        engine.view("qpos")[:, 2] = torch.tensor([0.5, 1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
        engine.forward()
    for groups in (None, (0, 1), (1,)):
        assert torch.equal(apart.ray(*rays(), groups), whole.ray(*rays(), groups))
    assert apart.made == []


def test_a_ground_that_is_moved_in_one_simulation_is_cast_there(engines):
    for engine in engines:
        engine.expand("geom_pos")[2, 1] = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64)
        engine.forward()
    whole, apart = engines
    far = whole.ray(*rays(), (0,))
    assert torch.equal(apart.ray(*rays(), (0,)), far)
    assert not torch.equal(far, BatchEngine(whole.model, 5, 1).ray(*rays(), (0,)))


def test_rays_on_many_geoms_see_only_near_ones_and_have_bitwise_the_same_length():
    tiles = "".join(
        f'<geom name="ground/{x}_{y}" type="box" size=".12 .12 {0.05 + 0.03 * ((x + y) % 3)}" '
        f'pos="{x / 4} {y / 4} 0" euler="{2 * x} {3 * y} {x * y}"/>'
        for x in range(-4, 5)
        for y in range(-4, 5)
    )
    whole, apart = (BatchEngine(model(GROUND, tiles, ROBOT), 5, 2) for _ in range(2))
    apart.cast_alone(0, lambda: model(GROUND, tiles))
    origins, ways = rays(999)
    ways[:, :100] = torch.eye(3).repeat(34, 1)[:100] * torch.tensor([1.0, 1.0, -1.0])
    far = whole.ray(origins, ways, (0,))
    assert torch.equal(apart.ray(origins, ways, (0,)), far)
    assert 0.2 < float((far < 0).float().mean()) < 0.8
    assert 0.0 < (apart._still[(0,)]._groups == 0).mean() < 1.0
    ids = torch.tensor([3])
    assert torch.equal(apart.ray(origins[ids, :1], ways[ids, :1], (0,), ids), far[ids, :1])
    assert apart.ray(origins[:0], ways[:0], (0,), ids[:0]).shape == (0, 999)


@pytest.mark.parametrize(
    "alone", [GROUND.replace('pos="1 0 .2"', 'pos="1 0 .3"'), GROUND.splitlines()[1], GROUND + "<geom size='1'/>"]
)
def test_a_ground_that_differs_from_the_models_is_not_used(alone):
    engine = BatchEngine(model(GROUND, ROBOT), 5, 1)
    far = engine.ray(*rays(), (0,))
    engine.cast_alone(0, lambda: model(alone))
    assert torch.equal(engine.ray(*rays(), (0,)), far)
