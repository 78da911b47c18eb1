import mujoco
import numpy as np
import pytest
import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.sim.batch_engine import BatchEngine

XML = """<mujoco><option timestep=".005" integrator="implicitfast"/>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="box" pos="0 0 .3"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/>
      <body name="arm" pos="0 0 .1"><joint name="hinge" axis="0 1 0"/>
        <geom type="capsule" size=".02" fromto="0 0 0 .2 0 0" mass=".3"/></body></body>
  </worldbody>
  <actuator><motor name="m" joint="hinge"/></actuator>
  <sensor><framepos name="p" objtype="body" objname="arm"/></sensor>
</mujoco>"""


@pytest.fixture
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture
def sim(model) -> BatchEngine:
    return BatchEngine(model, 3, nthread=1)


def steps(engine: BatchEngine, count: int) -> None:
    for _ in range(count):
        engine.step()


def _reference(sim: BatchEngine, i: int) -> mujoco.MjData:
    data = mujoco.MjData(sim.model)
    mujoco.mj_setState(sim.model, data, sim.state[i].numpy(), mujoco.mjtState.mjSTATE_INTEGRATION)
    mujoco.mj_fwdPosition(sim.model, data)
    mujoco.mj_fwdVelocity(sim.model, data)
    mujoco.mj_sensorPos(sim.model, data)
    return data


def test_derived_fields_describe_the_new_state_after_a_step(sim):
    xpos, cvel, sensors = sim.derived("xpos"), sim.derived("cvel"), sim.view("sensordata")
    sim.view("qvel")[:, 3] = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    steps(sim, 3)
    for i in range(3):
        data = _reference(sim, i)
        np.testing.assert_allclose(xpos[i], data.xpos, atol=1e-15)
        np.testing.assert_allclose(cvel[i], data.cvel, atol=1e-12)
        np.testing.assert_allclose(sensors[i], data.sensordata, atol=1e-15)
        np.testing.assert_allclose(sim.derived("xipos")[i], data.xipos, atol=1e-15)  # first read after the steps


def test_stepping_is_bitwise_a_plain_loop(sim, model):
    data = mujoco.MjData(model)
    sim.derived("xpos")
    for k in range(200):
        sim.view("ctrl")[1, 0] = np.sin(k / 10)
        data.ctrl[0] = np.sin(k / 10)
        sim.step()
        mujoco.mj_step(model, data)
    assert np.array_equal(sim.view("qpos")[1].numpy(), data.qpos)
    assert np.array_equal(sim.view("qvel")[1].numpy(), data.qvel)


def test_forward_refreshes_only_the_given_rows(sim):
    xpos = sim.derived("xpos")
    sim.view("qpos")[:, 0] = 5.0
    sim.forward(torch.tensor([1]))
    assert xpos[:, 1, 0].tolist() == [0.0, 5.0, 0.0]


def test_a_reset_zeroes_controls_and_forces_of_its_rows_but_not_positions_and_velocities(sim):
    sim.view("ctrl")[:] = 1.0
    sim.view("xfrc_applied")[:] = 1.0
    sim.view("qvel")[:, 0] = 1.0
    sim.step()
    motion = sim.motion.clone()
    sim.reset(torch.tensor([0, 2]))
    assert torch.equal(sim.motion, motion)  # A reset of the engine changes no position or velocity.
    assert sim.view("ctrl")[:, 0].tolist() == [0.0, 1.0, 0.0]
    assert sim.view("xfrc_applied").abs().sum(dim=(1, 2)).tolist() == [0.0, 18.0, 0.0]
    assert sim.view("qacc_warmstart").abs().sum(dim=1).gt(0).tolist() == [False, True, False]
    assert sim.view("time").tolist() == [0.0, sim.model.opt.timestep, 0.0]


@pytest.mark.parametrize(
    ("field", "bad"), [("qvel", float("nan")), ("qvel", float("inf")), ("qvel", 1e20), ("ctrl", float("nan"))]
)
def test_a_broken_simulation_is_reported_until_its_reset(sim, field, bad, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo would write its log file to the current folder.
    assert not sim.unstable().any()
    sim.view(field)[1, 0] = bad
    for _ in range(2):
        sim.step()
        assert sim.unstable().tolist() == [False, True, False]
    sim.reset(torch.tensor([1]))
    assert not sim.unstable().any()


def test_an_error_of_the_engine_names_the_simulations_and_the_others_continue():
    small = mujoco.MjModel.from_xml_string(XML.replace("<worldbody>", '<size memory="8K"/><worldbody>'))
    sim = BatchEngine(small, 3, nthread=1)
    sim.view("qpos")[1, 2] = 0.05
    with pytest.raises(SimulationFailure, match=r"1 of 3 simulations \(1\).*out of memory"):
        sim.step()
    assert (sim.view("qvel")[:, 2] < 0).tolist() == [True, False, True]


def test_per_simulation_mass_changes_only_its_row(model):
    sim = BatchEngine(model, 2, 1)
    sim.expand("body_mass")[1, 1] = 3.0
    sim.set_const()
    sim.view("xfrc_applied")[:, 1, 0] = 6.0
    sim.step()
    # A force along x turns an arm whose hinge axis is along y. Compare with models edited separately.
    for row, value in enumerate((1.0, 3.0)):
        own = mujoco.MjModel.from_xml_string(XML)
        own.body_mass[1] = value
        mujoco.mj_setConst(own, mujoco.MjData(own))
        data = mujoco.MjData(own)
        data.xfrc_applied[1, 0] = 6.0
        mujoco.mj_step(own, data)
        assert np.array_equal(sim.view("qvel")[row].numpy(), data.qvel)


def test_set_const_leaves_the_state_alone(sim):
    steps(sim, 20)
    before = sim.state.clone()
    sim.expand("body_ipos")[:, 1, 0] += 0.01
    sim.set_const()
    assert torch.equal(sim.state, before)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_restored_simulation_continues_to_the_bit(model, threads):
    first, second = BatchEngine(model, 4, 1), BatchEngine(model, 4, threads)
    for engine in (first, second):
        engine.derived("xpos")
    gen = torch.Generator().manual_seed(0)
    first.expand("body_mass")[:, 1] *= 1 + torch.rand(4, generator=gen, dtype=torch.float64)
    first.expand("body_ipos")[:, 1, 0] += 0.02
    first.set_const()
    first.expand("geom_friction")[:, :, 0] = 0.3
    steps(first, 150)
    saved = first.state_dict()
    state = first.state.clone()
    second.load_state_dict(saved)
    assert torch.equal(second.derived("xpos"), first.derived("xpos"))
    for engine in (first, second):
        steps(engine, 150)
    assert torch.equal(first.state, second.state)
    assert torch.equal(saved["state"], state)


def _down(*points):
    origins = torch.tensor(points).expand(3, -1, -1)
    return origins, torch.tensor([0.0, 0.0, -1.0]).expand_as(origins)


def test_the_length_of_a_ray_is_that_of_the_geometry(sim):
    sim.view("qpos")[:, 2] = torch.tensor([0.3, 0.5, 5.0], dtype=torch.float64)  # height of the box's centre, m
    origins, down = _down((0.0, 0.05, 2.0), (3.0, 0.0, 2.0))
    distances = sim.ray(origins, down)
    torch.testing.assert_close(distances[:, 1], torch.full((3,), 2.0, dtype=torch.float64))
    torch.testing.assert_close(distances[:, 0], torch.tensor([1.6, 1.4, 2.0], dtype=torch.float64))
    slanted = torch.tensor([0.0, 3.0, -4.0]).expand(3, 1, 3)
    assert sim.ray(origins[:, 1:], slanted)[:, 0].tolist() == pytest.approx([0.5, 0.5, 0.5])


def test_a_ray_that_meets_nothing_returns_minus_one_and_groups_select_what_stops_it(sim):
    origins, down = _down((0.0, 0.0, 2.0))
    assert sim.ray(origins, -down).tolist() == [[-1.0]] * 3
    assert sim.ray(origins, down, geom_groups=[3]).tolist() == [[-1.0]] * 3
    assert (sim.ray(origins, down, geom_groups=[0]) > 0).all()


def test_rays_and_extra_forward_calls_leave_the_trajectory_alone(model):
    plain, read = BatchEngine(model, 1, 1), BatchEngine(model, 1, 1)
    for engine in (plain, read):
        engine.derived("xpos")
    for _ in range(20):
        plain.step()
        read.step()
        read.forward()
        read.derived("xipos")
        read.ray(*(part[:1] for part in _down((0.0, 0.0, 2.0))))
    assert torch.equal(plain.state, read.state)


def test_a_constant_is_a_copy_of_the_models_field(sim, model):
    mass = sim.constant("body_mass")
    assert mass.tolist() == model.body_mass.tolist()
    mass.zero_()
    assert model.body_mass.sum() > 0
