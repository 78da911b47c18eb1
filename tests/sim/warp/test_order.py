from contextlib import nullcontext

import mujoco
import pytest
import torch

from sim.warp.models import XML, model, options
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.sim.warp_engine import WarpEngine

N = 8
# Boxes that lie on the ground and on each other; two of three hinges are at their limit.
PILE = """
<mujoco><option timestep=".005" integrator="implicitfast"/>
  <default><joint axis="0 1 0" limited="true" range="-.1 .1" frictionloss=".02" armature=".01"/>
    <geom friction=".1"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body pos="0 0 .1"><freejoint/><geom type="box" size=".2 .1 .1" mass="2"/>
      <body pos=".3 0 -.05"><joint name="a"/><geom type="box" size=".08 .05 .05" mass=".3"/></body>
      <body pos="-.3 0 -.05"><joint name="b"/><geom type="capsule" size=".05 .05" mass=".3"/></body>
      <body pos="0 .2 -.05"><joint name="c"/><geom type="cylinder" size=".05 .05" mass=".3"/></body>
    </body>
    <body pos="0 0 .25"><freejoint/><geom type="box" size=".1 .1 .05" mass="1"/></body>
  </worldbody>
  <sensor>
    <contact geom1="floor" num="4" reduce="mindist" data="force pos"/>
    <contact geom1="floor" num="4" reduce="none" data="force pos"/>
  </sensor>
</mujoco>
"""


@pytest.fixture(autouse=True)
def ordered_cpu():
    """Use the fixed order on the CPU too, where WarpEngine does not need it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("wheelleg_exp.sim.warp_engine._UNORDERED", ("cpu", "cuda"))
        yield


def pile(device: str, deterministic: bool, cone: str = "elliptic") -> WarpEngine:
    xml = PILE.replace("<option ", f'<option cone="{cone}" ')
    engine = WarpEngine(model(xml), N, options(device, graph=False, deterministic=deterministic))
    noise = torch.randn(N, engine.model.nv, generator=torch.Generator().manual_seed(1))
    engine.view("qvel").copy_(0.3 * noise)
    engine.view("qpos")[:, 7:10] = torch.tensor([0.101, -0.102, 0.0])
    return engine


def run(engine: WarpEngine, shuffle_seed: int, monkeypatch) -> torch.Tensor:
    """Make steps in which the geom pairs reach the narrow phase in a random order, as from a GPU's threads."""
    from mujoco_warp._src import collision_driver

    find, wp, gen = collision_driver.nxn_broadphase, engine._wp, torch.Generator().manual_seed(shuffle_seed)

    def shuffled(m, d, ctx, awake=None):
        find(m, d, ctx, awake)
        order = torch.randperm(int(d.ncollision.numpy()[0]), generator=gen).to(engine.device)
        for array in (ctx.collision_pair, ctx.collision_pairid, ctx.collision_worldid):
            values = wp.to_torch(array)
            values[: len(order)] = values[order]

    monkeypatch.setattr(collision_driver, "nxn_broadphase", shuffled)
    first = engine.state_dict()
    found = []
    for _ in range(5):
        engine.step()
        found.append(torch.cat((engine.state, engine.view("sensordata")), dim=1))
    engine.load_state_dict(first)
    monkeypatch.undo()
    return torch.stack(found)


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_no_result_depends_on_the_order_in_which_contacts_are_found(device, cone, monkeypatch):
    for deterministic in (True, False):
        engine = pile(device, deterministic, cone)
        one, other = (run(engine, seed, monkeypatch) for seed in (1, 2))
        assert int(engine._d.nacon.numpy()[0]) > 5 * N  # With few contacts, their order could not matter.
        assert torch.equal(one, other) == deterministic


def test_rows_of_limits_and_friction_are_sorted_by_type_and_joint(device):
    from mujoco_warp._src import constraint

    engine = pile(device, True)
    with engine._in_order():
        engine._mjw.forward(engine._m, engine._d)
        wp, data = engine._wp, engine._d
        fields = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss", "J")
        rows = [wp.to_torch(getattr(data.efc, name)) for name in fields]
        count = int((wp.to_torch(data.nf) + wp.to_torch(data.nl)).min())
        expected = [values.clone() for values in rows]
        order = torch.randperm(count, generator=torch.Generator().manual_seed(4)).to(engine.device)
        for values in rows:
            values[:, :count] = values[:, order]
        assert not torch.equal(rows[1], expected[1])
        constraint._sort_constraints(engine._m, data)
    assert count == 5
    assert all(map(torch.equal, rows, expected))
    kinds = [int(mujoco.mjtConstraint.mjCNSTR_FRICTION_DOF)] * 3 + [int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)] * 2
    assert rows[0][0, :count].tolist() == kinds
    assert rows[1][0, :count].tolist() == [6, 7, 8, 1, 2]  # degrees of freedom, then joints


@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_a_fixed_order_agrees_with_mujoco_warps_own_kernels_to_single_precision(device, cone):
    ours, theirs = (pile(device, each, cone) for each in (True, False))
    ours.step()
    theirs.step()
    counts = [engine._wp.to_torch(engine._d.solver_niter) for engine in (ours, theirs)]
    assert (counts[0] - counts[1]).abs().max() <= 1  # A wrong Hessian needs more iterations.
    for name, most in (("qpos", 1e-5), ("qvel", 1e-3)):
        torch.testing.assert_close(ours.view(name), theirs.view(name), rtol=0, atol=most)
    forces = [engine.view("sensordata").view(N, 2, 4, 6)[..., :3].sum(dim=2) for engine in (ours, theirs)]
    assert forces[1].abs().max() > 10.0  # The pile weighs 39 N.
    torch.testing.assert_close(*forces, rtol=1e-3, atol=1e-2)


def test_contacts_of_a_sensor_are_sorted_by_its_criterion_and_then_by_their_order(device):
    engine = pile(device, True)
    wp = engine._wp
    from wheelleg_exp.sim.warp_order import _sort_matches

    # A complement, ~n, means contact n in the other direction.
    found = torch.tensor([[[9, ~4, 7, ~8, 5, -1]]], dtype=torch.int32, device=device)
    criteria = torch.tensor([[[1.0, 2.0, 1.0, 1.0, 0.5, 9.0]]], device=device)
    count = torch.tensor([[5]], dtype=torch.int32, device=device)
    match, nmatch, criterion = (wp.from_torch(values) for values in (found, count, criteria))
    unused = wp.zeros((1, 2), dtype=int, device=device), wp.zeros(1, dtype=int, device=device)
    inputs = [*unused, nmatch, match, criterion, match]
    wp.launch_tiled(_sort_matches, dim=(1, 1), inputs=inputs, block_dim=32, device=device)
    assert found.flatten().tolist() == [5, 7, ~8, 9, ~4, -1]


def test_a_sensor_that_drops_contacts_is_an_error_only_if_the_order_must_be_fixed(device):
    for deterministic in (False, True):
        engine = pile(device, deterministic)
        engine._m.opt.contact_sensor_maxmatch = 2
        failure = pytest.raises(SimulationFailure, match=r"env\.sim\.deterministic: a contact sensor")
        with failure if deterministic else nullcontext():
            for _ in range(3):  # On a GPU, the error comes one or two steps late.
                engine.step()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('<body name="arm" ', '<body name="arm" gravcomp="1" ', "gravity compensation"),
        ('<geom name="arm" ', '<geom name="arm" adhesion="1" ', "adhesion"),
        ("<option ", '<option viscosity="1" ', "a fluid"),
        ("implicitfast", "implicit", "the integrator 'implicit'"),
        ("<sensor>", "<sensor><e_potential/>", "sensors of touch, force, torque, or energy"),
    ],
    ids=["gravcomp", "adhesion", "fluid", "implicit", "energy"],
)
def test_models_whose_sums_have_no_fixed_order_are_rejected(device, old, new, reason):
    changed = model(XML.replace(old, new))
    with pytest.raises(ConfigError, match=rf"env\.sim\.deterministic: .* robots with {reason}"):
        WarpEngine(changed, 1, options(device, deterministic=True))


def test_another_version_of_mujoco_warp_is_rejected(device, monkeypatch):
    monkeypatch.setattr("wheelleg_exp.sim.warp_order.version", lambda name: "4.1.0")
    with pytest.raises(ConfigError, match=r"mujoco-warp is 4\.1\.0"):
        WarpEngine(model(), 1, options(device, deterministic=True))
