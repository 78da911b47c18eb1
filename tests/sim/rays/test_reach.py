import mujoco
import numpy as np

from wheelleg_exp.sim.batch_engine import GeomBoxes

ROW = "".join(f'<geom type="box" size=".5 .5 .5" pos="{2 * x} 0 0"/>' for x in range(10))
MIXED = """
  <geom type="plane" size="0 0 .1" pos="0 0 -3"/>
  <geom type="box" size=".5 .2 .3" pos="1 0 .2" euler="10 20 30"/>
  <geom type="sphere" size=".3" pos="-1 .4 .1"/>
  <geom type="capsule" size=".1 .5" pos="0 1 0" euler="40 0 10"/>
  <geom type="cylinder" size=".2 .3" pos="0 -1 0" euler="0 70 10"/>
  <geom type="ellipsoid" size=".2 .3 .1" pos="-1 -1 0" euler="0 10 50"/>
  <geom type="hfield" hfield="h" pos="1 1 -.2"/>
  <geom type="mesh" mesh="m" pos="1 -1 .1" euler="20 10 5"/>"""
ASSETS = """<asset>
  <hfield name="h" nrow="2" ncol="2" size=".4 .4 .3 .1" elevation="0 1 .5 .2"/>
  <mesh name="m" vertex="0 0 0  .4 0 0  0 .3 0  0 0 .5"/></asset>"""


def model(geoms):
    return mujoco.MjModel.from_xml_string(f"<mujoco>{ASSETS}<worldbody>{geoms}</worldbody></mujoco>")


def reached(geoms, origin, *directions):
    ways = np.array(directions, dtype=float)
    return np.flatnonzero(GeomBoxes(model(geoms)).reached(np.broadcast_to(origin, ways.shape)[None], ways[None])[0])


def test_a_ray_reaches_the_boxes_on_its_way_alone():
    assert reached(ROW, [4.0, 0.0, 3.0], [0, 0, -1]).tolist() == [2]
    # The ray falls from z = 0.5 to -0.5 between x = 5 and x = 6.
    assert reached(ROW, [4.0, 0.0, 1.5], [1, 0, -1]).tolist() == [3]
    assert reached(ROW, [4.0, 0.0, 0.0], [1, 0, 0]).tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
    assert reached(ROW, [4.0, 0.0, 3.0], [0, 0, 1]).tolist() == []
    assert reached(ROW, [4.0, 3.0, 0.0], [1, 0, 0]).tolist() == []


def test_rays_together_reach_what_lies_between_them():
    assert reached(ROW, [4.0, 0.0, 4.5], [-1, 0, -1], [1, 0, -1]).tolist() == [0, 1, 2, 3, 4]
    assert reached(ROW, [4.0, 0.0, 3.0], [0, 0, -1], [0, 0, 1]).tolist() == [2]


def test_a_ray_reaches_everything_that_it_meets():
    both, rng = model(MIXED), np.random.default_rng(0)
    data = mujoco.MjData(both)
    mujoco.mj_forward(both, data)
    origins, ways = 4 * rng.random((2000, 1, 3)) - 2, rng.standard_normal((2000, 1, 3))
    ways[:300] = np.eye(3)[rng.integers(0, 3, 300), None] * rng.choice([-1, 1], (300, 1, 1))
    found, met, geom = GeomBoxes(both).reached(origins, ways), np.zeros(both.ngeom, dtype=int), np.zeros(1, np.int32)
    for number in range(both.ngeom):
        both.geom_group[:] = np.arange(both.ngeom) != number
        for row, (origin, way) in enumerate(zip(origins[:, 0], ways[:, 0], strict=True)):
            if mujoco.mj_ray(both, data, origin, way, np.eye(6, dtype=np.uint8)[0], 1, -1, geom) >= 0:
                met[number] += 1
                assert found[row, number], (number, origin, way)
    assert (met > 5).all()
    assert found[:, 1:].mean() < 0.5
