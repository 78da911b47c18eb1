"""Third-party USD files that were made from MJCF convert to MuJoCo models that equal the models of the original MJCF.

The original MJCF files are ``assets/<name>/mjcf/<name>.xml`` in the corpus. These MJCF files have six significant
digits and the USD files have more, which causes differences of up to 5e-6.
"""

import mujoco
import numpy as np
import pytest

from ..corpus import convert_asset, expectations
from .same_model import Obj, Pair, difference, name_of

pytestmark = pytest.mark.corpus

ROBOTS = ("go1", "cassie", "barkour_vb", "tidybot", "aero_hand")
TOLERANCE = 1e-5
# Cassie's loops are closed by stiff connects, so rounding its MJCF to six digits changes the accelerations by 5e-4.
# The USD file of aero_hand rotates some bodies, over which tendons pass, by 8e-5 rad.
WIDER = {
    ("cassie", "acceleration"): 5e-4,
    ("aero_hand", "rotation"): 2e-4,
    ("aero_hand", "acceleration"): 2e-4,
    ("aero_hand", "tendon"): 5e-5,
}
JOINT = ("jnt_stiffness", "jnt_actfrclimited", "jnt_actgravcomp", "jnt_limited")
LIMIT = ("jnt_range", "jnt_solref", "jnt_solimp", "jnt_margin")
DOF = ("dof_armature", "dof_damping", "dof_frictionloss")
ACTUATOR = (
    *("gainprm", "biasprm", "dynprm", "gaintype", "biastype", "dyntype", "trntype", "gear", "group"),
    *("ctrlrange", "ctrllimited", "forcerange", "forcelimited", "actlimited"),
)
TENDON = (
    *("num", "stiffness", "damping", "frictionloss", "armature", "limited", "range", "margin"),
    *("length0", "lengthspring", "rgba", "width", "group"),
)


@pytest.fixture(scope="module", params=ROBOTS)
def pair(request, corpus, tmp_path_factory) -> Pair:
    name = request.param
    expected = next(item for item in expectations(corpus) if item["name"] == name)
    done = convert_asset(corpus, expected, tmp_path_factory.mktemp(name) / f"{name}.xml")
    path = corpus / "assets" / name / "mjcf" / f"{name}.xml"
    made = Pair(mujoco.MjModel.from_xml_path(str(path)), mujoco.MjModel.from_xml_path(str(done.output)))
    made.name = name
    return made


def within(pair: Pair, what: str) -> float:
    return WIDER.get((pair.name, what), TOLERANCE)


@pytest.mark.parametrize("what", ["nbody", "njnt", "nv", "nu", "na", "ntendon", "neq"])
def test_nothing_is_lost_and_nothing_is_added(pair, what):
    assert getattr(pair.ours, what) == getattr(pair.original, what)


def test_masses_centres_and_inertias(pair):
    first, second = pair.bodies
    heavy = pair.original.body_mass[first] > 0
    for values in ("body_mass", "body_ipos"):
        before, after = getattr(pair.original, values)[first][heavy], getattr(pair.ours, values)[second][heavy]
        for one, other in zip(before, after, strict=True):
            assert difference(one, other) < TOLERANCE
    assert (pair.ours.body_mass[second][~heavy] == 0).all()
    for before, after in zip(*pair.tensors(), strict=True):
        assert difference(before, after) < TOLERANCE


def test_joints_with_their_limits_and_passive_forces(pair):
    kinds = pair.original.jnt_type
    one = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    single = [i for i in range(pair.original.njnt) if kinds[i] in one]
    ours = [pair.joints[i] for i in single]
    for values in JOINT:
        assert difference(getattr(pair.original, values)[single], getattr(pair.ours, values)[ours]) < TOLERANCE, values
    limited = [i for i in single if pair.original.jnt_limited[i]]
    ours = [pair.joints[i] for i in limited]
    for values in LIMIT:
        assert difference(getattr(pair.original, values)[limited], getattr(pair.ours, values)[ours]) < TOLERANCE, values
    for values in DOF:
        assert difference(getattr(pair.original, values), getattr(pair.ours, values)[pair.velocities]) < TOLERANCE
    for values in ("qpos0", "qpos_spring"):
        assert difference(getattr(pair.original, values), getattr(pair.ours, values)[pair.positions], 1.0) < TOLERANCE


def test_actuators(pair):
    first, second = pair.actuators
    assert len(first) == pair.original.nu
    for key in ACTUATOR:
        before, after = (getattr(m, f"actuator_{key}") for m in (pair.original, pair.ours))
        assert difference(before[first], after[second]) < TOLERANCE, key
    kinds = {int(mujoco.mjtTrn.mjTRN_JOINT): Obj.mjOBJ_JOINT, int(mujoco.mjtTrn.mjTRN_TENDON): Obj.mjOBJ_TENDON}
    for one, other in zip(first, second, strict=True):
        parts = ((pair.original, one), (pair.ours, other))
        names = [name_of(m, kinds[int(m.actuator_trntype[i])], m.actuator_trnid[i][0]) for m, i in parts]
        assert names[0] == names[1]


def test_tendons(pair):
    first, second = pair.tendons
    for key in TENDON:
        before, after = (getattr(m, f"tendon_{key}") for m in (pair.original, pair.ours))
        assert difference(before[first], after[second]) < within(pair, "tendon"), key


def test_equalities_and_scene_options(pair):
    for key in ("eq_type", "eq_solref", "eq_solimp", "eq_active0"):
        np.testing.assert_allclose(getattr(pair.ours, key), getattr(pair.original, key), rtol=TOLERANCE)
    for key in ("gravity", "cone", "impratio", "integrator"):
        np.testing.assert_allclose(getattr(pair.ours.opt, key), getattr(pair.original.opt, key), rtol=1e-7)
    assert pair.ours.opt.disableflags == pair.original.opt.disableflags


def test_contact_parameters_of_colliders(pair):
    for one, other in zip(*pair.bodies, strict=True):
        for key in ("condim", "priority", "friction", "solref", "solimp", "margin", "gap"):
            before, after = contacts(pair.original, one, key), contacts(pair.ours, other, key)
            assert before.shape == after.shape
            np.testing.assert_allclose(after, before, rtol=TOLERANCE, atol=1e-9)


def contacts(model: mujoco.MjModel, body: int, key: str) -> np.ndarray:
    touches = (model.geom_contype | model.geom_conaffinity) > 0
    kept = touches & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_ELLIPSOID))
    rows = getattr(model, f"geom_{key}")[(model.geom_bodyid == body) & kept]
    return np.sort(rows.reshape(len(rows), rows[0].size if len(rows) else 0), axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_poses_mass_matrix_and_accelerations_in_random_states(pair, seed):
    pair.draw(np.random.default_rng(seed))
    first, second = pair.data
    theirs, ours = pair.bodies
    assert difference(first.xpos[theirs], second.xpos[ours]) < TOLERANCE
    assert difference(first.xmat[theirs], second.xmat[ours]) < within(pair, "rotation")
    assert difference(*pair.masses()) < TOLERANCE
    assert difference(first.qacc, second.qacc[pair.velocities]) < within(pair, "acceleration")
    assert difference(first.qfrc_actuator, second.qfrc_actuator[pair.velocities]) < within(pair, "acceleration")
    assert difference(first.qfrc_passive, second.qfrc_passive[pair.velocities]) < within(pair, "acceleration")
