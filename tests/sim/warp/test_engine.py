import math
import subprocess
import sys

import mujoco
import numpy as np
import pytest
import torch

from sim.warp.models import XML, model, options
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.warp_engine import WarpEngine, capacity_for

N = 4


def warp(device: str, num_envs: int = N, xml: str = XML, **changes) -> WarpEngine:
    return WarpEngine(model(xml), num_envs, options(device, **changes))


@pytest.fixture(scope="module")
def shared(device) -> WarpEngine:
    return warp(device)


@pytest.fixture
def sim(shared) -> WarpEngine:
    first = {name: value.expand_as(shared._state[name]) for name, value in shared._initial.items()}
    shared._fields.restore({})
    for name, value in first.items():
        shared._state[name].copy_(value)
    shared._bad.zero_()
    shared.forward()
    return shared


def scatter(*engines) -> None:
    gen = torch.Generator().manual_seed(3)
    for engine in engines:
        gen.manual_seed(3)
        qpos, qvel = engine.view("qpos"), engine.view("qvel")
        turned = torch.nn.functional.normalize(torch.randn(N, 4, generator=gen, dtype=torch.float64), dim=1)
        qpos[:, 3:7] = turned.to(qpos)
        qpos[:, :2] = 0.0
        qpos[:, 2] = torch.tensor([1.0, 0.11, 0.099, 0.3], dtype=torch.float64).to(qpos)
        qpos[:, 7] = torch.tensor([0.0, 0.5, 1.1, -0.4], dtype=torch.float64).to(qpos)
        qvel.copy_(torch.randn(N, 7, generator=gen, dtype=torch.float64).to(qvel))
        engine.view("ctrl").copy_(torch.randn(N, 1, generator=gen, dtype=torch.float64).to(qpos))
        engine.view("xfrc_applied")[:, 1].copy_(torch.randn(N, 6, generator=gen, dtype=torch.float64).to(qpos))


def close(ours: torch.Tensor, theirs: torch.Tensor, rtol: float, atol: float) -> None:
    torch.testing.assert_close(ours.double().cpu(), theirs.double(), rtol=rtol, atol=atol)


def require_equal_motion(ours: WarpEngine, theirs: BatchEngine, of_qpos: float, of_qvel: float) -> None:
    scatter(ours, theirs)
    for _ in range(3):
        ours.step()
        theirs.step()
    close(ours.view("qpos"), theirs.view("qpos"), 0, of_qpos)
    close(ours.view("qvel"), theirs.view("qvel"), of_qvel, of_qvel)


def steps(engine: WarpEngine, count: int) -> None:
    for _ in range(count):
        engine.step()
        engine.unstable()


def contacts(engine) -> torch.Tensor:
    slots = engine.view("sensordata").view(N, 2, 4, 7)
    return (slots[..., 1:2] * slots[..., 4:7]).sum(dim=2)


def test_one_step_agrees_with_mujoco_to_single_precision(sim):
    batch = BatchEngine(sim.model, N, 1)
    for engine in (sim, batch):
        for name in ("xpos", "xquat", "xmat", "xipos", "cvel", "subtree_com"):
            engine.derived(name)
        engine.view("actuator_force"), engine.view("sensordata")  # Both engines update outputs that were read before.
    require_equal_motion(sim, batch, 2e-6, 1e-4)
    close(sim.view("actuator_force"), batch.view("actuator_force"), 1e-4, 1e-5)
    assert batch.view("sensordata").abs().max() > 10.0  # A body touches the ground.
    close(contacts(sim), contacts(batch), 1e-3, 1e-2)
    for name in ("xpos", "xquat", "xmat", "xipos", "cvel", "subtree_com"):
        assert sim.view(name).shape == batch.view(name).shape
        close(sim.view(name), batch.view(name), 1e-4, 2e-4)


def test_a_thousand_steps_end_where_mujocos_do(sim):
    batch = BatchEngine(sim.model, N, 1)
    for engine in (sim, batch):
        engine.view("sensordata")
        engine.view("qpos")[:, 2] = torch.linspace(0.1, 0.4, N).to(engine.view("qpos"))
        for _ in range(400):
            engine.step()
    close(sim.view("qpos")[:, 2], batch.view("qpos")[:, 2], 0, 1e-4)
    close(sim.view("qpos")[:, 7], batch.view("qpos")[:, 7], 0, 1e-3)
    weight = 2.3 * 9.81
    close(contacts(sim)[..., 2].abs().sum(dim=1), torch.full((N,), weight), 0.01, 0)


def test_fields_of_the_model_act_on_their_own_simulation_as_mujocos_do(device):
    ours, batch = warp(device), BatchEngine(model(), N, 1)
    for engine in (ours, batch):
        scale = torch.tensor([0.5, 1.0, 2.0, 3.0]).to(engine.view("qpos"))
        engine.expand("body_mass")[:, 1] *= scale
        engine.expand("body_inertia")[:, 1] *= scale.unsqueeze(1)
        engine.expand("body_ipos")[:, 1, 0] += 0.01 * scale
        engine.expand("geom_friction")[:, :, 0] = 0.2 * scale.unsqueeze(1)
        engine.expand("dof_armature")[:, 6] = 0.02 * scale
        engine.expand("actuator_biasprm")[:, 0, 1] = -2.0 * scale
        engine.expand("opt.gravity")[:, 0] = scale
        engine.set_const()
    for name in ("dof_invweight0", "body_invweight0", "body_subtreemass"):
        each = ours._fields.own[name]
        for i in range(N):
            own = model()
            for field in ("body_mass", "body_inertia", "body_ipos", "dof_armature"):
                getattr(own, field)[:] = batch.expanded[field][i].numpy()
            mujoco.mj_setConst(own, mujoco.MjData(own))
            np.testing.assert_allclose(each[i].cpu(), getattr(own, name), rtol=1e-4, atol=1e-6)
    require_equal_motion(ours, batch, 5e-6, 3e-4)


def test_a_field_that_all_simulations_share_is_rejected_by_name(sim):
    with pytest.raises(ConfigError, match=r"env\.sim\.engine: mujoco-warp has only one value of 'jnt_limited'"):
        sim.expand("jnt_limited")
    with pytest.raises(ConfigError, match="does not have the field 'qfrc_nobody'"):
        sim.view("qfrc_nobody")


def test_a_reset_zeroes_all_of_its_rows_but_finite_positions_and_velocities(sim):
    scatter(sim)
    sim.step()
    qpos, qvel = sim.view("qpos").clone(), sim.view("qvel").clone()
    sim.view("qvel")[2, 0] = math.nan
    sim.reset(torch.tensor([0, 2], device=sim.device))
    assert torch.equal(sim.view("qpos"), qpos)
    assert float(sim.view("qvel")[2, 0]) == 0.0
    qvel[2, 0] = 0.0
    assert torch.equal(sim.view("qvel"), qvel)
    assert sim.view("ctrl")[:, 0].ne(0).tolist() == [False, True, False, True]
    assert sim.view("xfrc_applied").abs().sum(dim=(1, 2)).ne(0).tolist() == [False, True, False, True]
    assert sim.view("qacc_warmstart").abs().sum(dim=1).ne(0).tolist() == [False, True, False, True]
    assert sim.view("time").ne(0).tolist() == [False, True, False, True]


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e20])
def test_a_broken_simulation_is_reported_until_its_reset_and_breaks_no_other(sim, bad):
    scatter(sim)
    sim.view("qvel")[1, 0] = bad
    for _ in range(2):
        sim.step()
        assert sim.unstable().tolist() == [False, True, False, False]
    assert sim.view("qpos")[[0, 2, 3]].isfinite().all()
    sim.reset(torch.tensor([1], device=sim.device))
    assert not sim.unstable().any()
    sim.step()
    assert not sim.unstable().any()


@pytest.mark.parametrize("name", ["qpos", "qvel"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_affects_the_total_of_its_own_rows(sim, name, bad):
    sim.view(name)[2, -1] = bad
    for rows, spoilt in ((torch.tensor([0, 2]), True), (torch.tensor([3, 1, 0]), False), (slice(None), True)):
        found = sim.total(rows if isinstance(rows, slice) else rows.to(sim.device))
        assert bool(found.isfinite()) is not spoilt


def test_rays_have_their_geometric_length(sim):
    sim.view("qpos")[:, 2] = torch.tensor([0.3, 0.5, 0.7, 5.0])
    origins = torch.tensor([(0.0, 0.0, 2.0), (3.0, 0.0, 2.0)], device=sim.device).expand(N, -1, -1)
    down = torch.tensor([0.0, 0.0, -1.0], device=sim.device).expand_as(origins)
    far = sim.ray(origins, down)
    assert far[:, 1].tolist() == pytest.approx([2.0] * N)
    assert far[:3, 0].tolist() == pytest.approx([2 - 0.3 - 0.13, 2 - 0.5 - 0.13, 2 - 0.7 - 0.13], abs=0.031)
    slanted = torch.tensor([0.0, 3.0, -4.0], device=sim.device).expand(N, 1, 3)
    assert sim.ray(origins[:, 1:], slanted)[:, 0].tolist() == pytest.approx([0.5] * N)
    assert sim.ray(origins, -down)[:3, 1].tolist() == [-1.0] * 3
    assert sim.ray(origins, down, geom_groups=[0])[:, 0].tolist() == pytest.approx([2.0] * N)
    some = torch.tensor([2, 0], device=sim.device)
    assert torch.equal(sim.ray(origins[some], down[some], ids=some), far[some])


@pytest.mark.parametrize(
    ("room", "key"),
    [({"nconmax": 1, "njmax": 64}, r"env\.sim\.nconmax"), ({"nconmax": 8, "njmax": 3}, r"env\.sim\.njmax")],
)
def test_too_many_contacts_are_an_error_that_names_the_setting(device, room, key):
    engine = warp(device, num_envs=2, **room)
    engine.view("qpos")[:, 2] = 0.09
    engine.view("qpos")[:, 3:7] = torch.tensor([0.7071, 0.0, 0.7071, 0.0])
    with pytest.raises(SimulationFailure, match=rf"{key}: there are more than .* or more"):
        steps(engine, 40)


def test_a_ground_of_several_boxes_has_room_for_more_contacts():
    plane = '<geom type="plane" size="1 1 .1"/>'
    ball = '<body><freejoint/><geom size=".1"/></body>'
    box = '<geom type="box" size=".1 .1 .1"/>'
    drawn = box.replace("/>", ' contype="0" conaffinity="0"/>')
    rooms = [
        capacity_for(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{text}</worldbody></mujoco>"), 0, 0).contacts
        for text in (plane + ball, plane + box + ball, plane + drawn + ball)
    ]
    assert rooms == [24, 48, 24]


def test_a_restored_simulation_continues(device):
    first, second = warp(device), warp(device)
    first.derived("xpos")
    first.expand("body_mass")[:, 1] *= torch.tensor([1.0, 1.1, 1.2, 1.3], device=first.device)
    first.set_const()
    first.expand("geom_friction")[:, :, 0] = 0.3
    scatter(first)
    for _ in range(20):
        first.step()
    saved = first.state_dict()
    second.expand("dof_damping")[:] = 7.0  # The saved state lacks this model field.
    second.load_state_dict(saved)
    for _ in range(20):
        first.step()
        second.step()
    if first.exact:
        assert torch.equal(first.state, second.state)
    close(first.state.cpu(), second.state.cpu(), 1e-2, 1e-2)
    assert not torch.equal(first.view("qpos"), saved["state"]["qpos"])


def test_the_cpu_device_repeats_to_the_bit(sim):
    if not sim.exact:
        pytest.skip("a GPU's sums come in any order")
    ends = []
    for _ in range(2):
        sim.reset(torch.arange(N))
        scatter(sim)
        for _ in range(100):
            sim.step()
        ends.append(sim.state.clone())
    assert torch.equal(*ends)


def test_numbers_of_the_model_have_the_engines_type(sim):
    assert sim.constant("body_mass").dtype == torch.float32
    assert sim.constant("geom_group").dtype == torch.int32
    assert sim.state.dtype == sim.motion.dtype == torch.float32


def test_a_missing_package_is_reported_with_the_command_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    with pytest.raises(ConfigError, match=r"needs the package mujoco_warp.*pip install 'wheelleg_exp\[gpu\]'"):
        warp("cpu")


def test_a_missing_device_is_reported_with_the_existing_devices():
    with pytest.raises(
        ConfigError, match=r"env\.sim\.device: the device 'cuda:99' does not exist.*expected one of cpu"
    ):
        warp("cuda:99")


def test_an_unsupported_model_is_rejected_with_the_reason(device):
    xml = XML.replace("<option ", "<option solver='PGS' ")
    with pytest.raises(ConfigError, match=r"env\.sim\.engine: mujoco-warp cannot simulate this model: mjSOL_PGS"):
        warp(device, xml=xml)


def test_warp_is_imported_only_if_it_is_configured():
    code = "import sys, wheelleg_exp.build, wheelleg_exp.sim.scene; sys.exit('warp' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_limits_of_joints_are_written_where_all_are_limited(make_env, device):
    arm = make_env("arm", sim={"engine": "warp", "device": device})
    limits = torch.tensor([[[-0.3, 0.3]], [[-math.inf, math.inf]]], device=arm.device)
    arm.scene.robot.write_joint_position_limit_to_sim(limits, [0], [0, 1])
    joint = arm.scene.robot.layout.joint_ids[0]
    assert arm.scene.sim.expanded["jnt_range"][0, joint].tolist() == pytest.approx([-0.3, 0.3])
    assert arm.scene.sim.expanded["jnt_range"][1, joint, 1] > 1e6


def test_the_cpu_accepts_all_models_because_its_order_is_always_fixed():
    tendon = XML.replace("<actuator>", '<tendon><fixed><joint joint="hinge" coef="1"/></fixed></tendon><actuator>')
    assert WarpEngine(model(tendon), 1, options("cpu", deterministic=True)).exact
