# ruff: noqa: ARG001, UP018  (kernels have fixed parameters; Warp needs float() for variables that loops change)
"""A fixed order of contacts, constraint rows, and sums in mujoco-warp, so that a GPU repeats a simulation to the bit.

mujoco-warp 4.0.0 gives each contact and each constraint row the next free slot of a buffer, in the order in which the
GPU's threads arrive. Sums over slots then round differently in each run. ``FixedOrder`` groups the contacts by
simulation, sorts those of a simulation by their geoms, and numbers the constraint rows in this order. One thread adds
the terms of a sum, so that no sum uses atomic additions of floats.
"""

import dataclasses
import functools
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco_warp._src import collision_driver, constraint, math, sensor, solver, types

from wheelleg_exp.errors import ConfigError

# Do not import annotations from __future__ here, because Warp reads annotations as types, not as strings.
wp.set_module_options({"enable_backward": False})

Ints, Ints2, Ints3, Bools, Geoms = wp.array[int], wp.array2d[int], wp.array3d[int], wp.array[bool], wp.array[wp.vec2i]
Floats, Floats2, Floats3, Fives = wp.array[float], wp.array2d[float], wp.array3d[float], wp.array[types.vec5]
Pairs, Vectors, Frames = wp.array[wp.vec2], wp.array[wp.vec3], wp.array[wp.mat33]

KEY = "env.sim.deterministic"
_VERSION = "4.0.0"
_LEAST_MATCHES = 64  # Above this number, a contact sensor drops contacts in no fixed order (``Overflow``).
_MOVED = (
    *("dist", "pos", "frame", "includemargin", "friction", "solref", "solreffriction", "solimp", "dim", "geom"),
    *("worldid", "type", "geomcollisionid", "adhesion"),
)
_ROW_FIELDS = ("type", "id", "pos", "margin", "D", "vel", "aref", "frictionloss", "J")
_ADDING = ("TOUCH", "FORCE", "TORQUE", "E_POTENTIAL", "E_KINETIC")
_ADDING_SENSORS = [int(getattr(mujoco.mjtSensor, f"mjSENS_{name}")) for name in _ADDING]


def unordered(model: mujoco.MjModel, on_device: Any) -> str | None:
    """Return a property of the model for which mujoco-warp adds numbers in no fixed order; None if there is none."""
    joints = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    found = {
        "more than 32 degrees of freedom": on_device.is_sparse,
        "tendons": model.ntendon,
        "flexes": model.nflex,
        "gravity compensation": model.body_gravcomp.any(),
        "adhesion": on_device.flg_adhesion,
        "a fluid (density, viscosity, or wind)": on_device.has_fluid,
        "the integrator 'implicit'": model.opt.integrator == int(mujoco.mjtIntegrator.mjINT_IMPLICIT),
        "actuators that do not drive a joint": not np.isin(model.actuator_trntype, joints).all(),
        "more than two actuators on a joint": np.bincount(model.actuator_trnid[:, 0].clip(0)).max(initial=0) > 2,
        "sensors of touch, force, torque, or energy": np.isin(model.sensor_type, _ADDING_SENSORS).any(),
    }
    return next((name for name, has in found.items() if has), None)


class FixedOrder:
    """Replaces functions of mujoco-warp while a physics step of one engine is launched or captured.

    Raise ConfigError if the installed version of mujoco-warp is not the one that this module was written for, or if
    sums of the model have no fixed order.
    """

    def __init__(self, model: mujoco.MjModel, on_device: Any, data: Any) -> None:
        if (found := version("mujoco-warp")) != _VERSION:
            raise ConfigError(f"mujoco-warp is {found}", key=KEY, expected=f"false, or mujoco-warp {_VERSION}")
        if (reason := unordered(model, on_device)) is not None:
            message = f"the engine 'warp' does not repeat robots with {reason} to the bit"
            raise ConfigError(message, key=KEY, expected="false, or engine: mujoco")
        on_device.opt.deterministic = int(types.DeterminismType.CONSTRAINT)  # Only this calls _sort_constraints.
        on_device.opt.contact_sensor_maxmatch = max(_LEAST_MATCHES, on_device.opt.contact_sensor_maxmatch)
        self._found = dataclasses.replace(
            data.contact, **{name: wp.empty_like(getattr(data.contact, name)) for name in _MOVED}
        )
        self._next = wp.empty(data.naconmax, dtype=int)
        self._first, self._count, self._start = (wp.empty(data.nworld, dtype=int) for _ in range(3))
        self._used = wp.empty(1, dtype=int)
        self._find = collision_driver._narrowphase
        self._replaced = (
            (collision_driver, "_narrowphase", self._narrowphase),
            (constraint, "_sort_constraints", _sort_constraints),
            (constraint, "_efc_contact_init", lambda cone, *_: _contact_rows(cone == types.ConeType.ELLIPTIC)),
            (solver, "_use_incremental", lambda _: False),  # Its sums are in the order in which rows change state.
            (solver, "_update_gradient_grad", lambda *_: _gradient),
            (solver, "_update_gradient_JTCJ_dense", lambda *_: _cone_hessian),
            (sensor, "_contact_sort", lambda *_: _sort_matches),
        )

    @contextmanager
    def active(self) -> Iterator[None]:
        """Replace the functions inside the ``with`` block."""
        before = [(module, name, getattr(module, name)) for module, name, _ in self._replaced]
        try:
            for module, name, new in self._replaced:
                setattr(module, name, new)
            yield
        finally:
            for module, name, old in before:
                setattr(module, name, old)

    def _narrowphase(self, m: Any, d: Any, ctx: Any) -> None:
        """Find the contacts, and copy them to ``d.contact`` in the order of simulations and geoms."""
        self._find(m, dataclasses.replace(d, contact=self._found), ctx)
        self._first.fill_(-1)
        self._count.zero_()
        self._used.zero_()
        lists = [self._first, self._count, self._next]
        wp.launch(_link, dim=d.naconmax, inputs=[d.nacon, self._found.worldid, *lists])
        wp.launch(_reserve, dim=d.nworld, inputs=[self._count, self._used, self._start])
        found, placed = ([getattr(contact, name) for name in _MOVED] for contact in (self._found, d.contact))
        inputs = [d.nacon, self._first, self._next, self._start, *found, *placed, d.contact.efc_address]
        wp.launch(_place, dim=d.naconmax, inputs=inputs)


# fmt: off
@wp.kernel
def _link(nacon: Ints, world: Ints, first: Ints, count: Ints, following: Ints) -> None:
    # fmt: on
    """Make a linked list of the contacts of each simulation, in any order, and count them."""
    contact = wp.tid()
    if contact < wp.min(nacon[0], world.shape[0]):
        following[contact] = wp.atomic_exch(first, world[contact], contact)
        wp.atomic_add(count, world[contact], 1)


@wp.kernel
def _reserve(count: Ints, used: Ints, start: Ints) -> None:
    """Reserve consecutive slots for the contacts of each simulation; no result depends on which ones."""
    world = wp.tid()
    start[world] = wp.atomic_add(used, 0, count[world])


# fmt: off
@wp.kernel
def _place(
    nacon: Ints, first: Ints, following: Ints, start: Ints, dist: Floats, pos: Vectors, frame: Frames,
    includemargin: Floats, friction: Fives, solref: Pairs, solreffriction: Pairs, solimp: Fives, dim: Ints,
    geom: Geoms, world: Ints, kind: Ints, number: Ints, adhesion: Floats, dist_out: Floats, pos_out: Vectors,
    frame_out: Frames, includemargin_out: Floats, friction_out: Fives, solref_out: Pairs, solreffriction_out: Pairs,
    solimp_out: Fives, dim_out: Ints, geom_out: Geoms, world_out: Ints, kind_out: Ints, number_out: Ints,
    adhesion_out: Floats, efc_address_out: Ints2,
) -> None:
    # fmt: on
    """Copy each contact to its place among the contacts of its simulation.

    The order is that of the first geom, the second geom, and the contact's number within this pair of geoms.
    """
    own = wp.tid()
    if own >= wp.min(nacon[0], world.shape[0]):
        return
    one, two, three = geom[own][0], geom[own][1], number[own]
    slot = int(start[world[own]])
    other = int(first[world[own]])
    while other >= 0:
        a, b, c = geom[other][0], geom[other][1], number[other]
        if a < one or (a == one and (b < two or (b == two and c < three))):
            slot += 1
        other = following[other]
    dist_out[slot] = dist[own]
    pos_out[slot] = pos[own]
    frame_out[slot] = frame[own]
    includemargin_out[slot] = includemargin[own]
    friction_out[slot] = friction[own]
    solref_out[slot] = solref[own]
    solreffriction_out[slot] = solreffriction[own]
    solimp_out[slot] = solimp[own]
    dim_out[slot] = dim[own]
    geom_out[slot] = geom[own]
    world_out[slot] = world[own]
    kind_out[slot] = kind[own]
    number_out[slot] = number[own]
    adhesion_out[slot] = adhesion[own]
    for i in range(efc_address_out.shape[1]):
        efc_address_out[slot, i] = -1


@wp.func
def _is_first(contact: int, world: Ints) -> bool:
    """Return whether a contact is the first one of its simulation."""
    if contact == 0:
        return True
    return world[contact - 1] != world[contact]


# The parameters of the following kernels are those of the kernels that they replace.


@functools.cache
def _contact_rows(elliptic: bool) -> Any:
    """Return the kernel that numbers the constraint rows of contacts; one thread per simulation works."""

    # fmt: off
    @wp.kernel(module="unique", enable_backward=False)
    def contact_rows(
        body_weldid: Ints, body_dofnum: Ints, body_dofadr: Ints, dof_parentid: Ints, geom_bodyid: Ints, njmax: int,
        njmax_nnz: int, nacon: Ints, dist: Floats, condim: Ints, includemargin: Floats, adhesion: Floats,
        world_of: Ints, geom: Geoms, kind: Ints, nefc: Ints, efc_address: Ints2, efc_id: Ints2, jtdaj_adr: Ints2,
        jtdaj_nrow: Ints2, jtdaj_nblock: Ints, J_rownnz: Ints2, J_rowadr: Ints2, Jqvel: Floats2, efc_nnz: Ints,
    ) -> None:
        # fmt: on
        first = wp.tid()
        count = wp.min(nacon[0], world_of.shape[0])
        if first >= count:
            return
        if not _is_first(first, world_of):
            return
        world = world_of[first]
        row = int(nefc[world])
        for contact in range(first, count):
            if world_of[contact] != world:
                break
            is_active = dist[contact] < includemargin[contact] or adhesion[contact] != 0.0
            if is_active and (kind[contact] & int(types.ContactType.CONSTRAINT.value)) != 0:
                rows = condim[contact]
                if wp.static(not elliptic):
                    rows = wp.max(1, 2 * (rows - 1))
                for i in range(rows):
                    if row < njmax:
                        efc_address[contact, i] = row
                        efc_id[world, row] = contact
                    row += 1
        nefc[world] = row

    return contact_rows


# fmt: off
@wp.kernel
def _gradient(
    qfrc_smooth: Floats2, qfrc_constraint: Floats2, efc_Ma: Floats2, state_changed_count: Ints, done: Bools,
    grad: Floats2, grad_dot: Floats,
) -> None:
    # fmt: on
    """Compute the solver's gradient; the thread of the first degree of freedom adds the squares."""
    world, dof = wp.tid()
    if done[world]:
        return
    grad[world, dof] = efc_Ma[world, dof] - qfrc_smooth[world, dof] - qfrc_constraint[world, dof]
    if dof == 0:
        total = float(0.0)
        for i in range(qfrc_smooth.shape[1]):
            value = efc_Ma[world, i] - qfrc_smooth[world, i] - qfrc_constraint[world, i]
            total += value * value
        grad_dot[world] = total


# fmt: off
@wp.kernel
def _cone_hessian(
    impratio_invsqrt: Floats, dof_tri_row: Ints, dof_tri_col: Ints, dist: Floats, includemargin: Floats,
    friction: Fives, condim: Ints, efc_address: Ints2, world_of: Ints, J: Floats3, D: Floats2, state: Ints2,
    naconmax: int, nacon: Ints, Jaref: Floats2, done: Bools, passes: int, threads: int, h: Floats3,
) -> None:
    # fmt: on
    """Add the curvature of friction cones to an entry of the Hessian; one thread adds all contacts of a simulation."""
    start, entry = wp.tid()
    one, two = dof_tri_row[entry], dof_tri_col[entry]
    count = wp.min(nacon[0], naconmax)
    for i in range(passes):
        first = start + i * threads
        if first >= count:
            return
        world = world_of[first]
        if done[world]:
            continue
        if not _is_first(first, world_of):
            continue
        total = float(0.0)
        for contact in range(first, count):
            if world_of[contact] != world:
                break
            normal = efc_address[contact, 0]
            if condim[contact] == 1 or normal < 0 or dist[contact] >= includemargin[contact]:
                continue
            if state[world, normal] != int(types.ConstraintState.CONE.value):
                continue
            scales = friction[contact]
            mu = scales[0] * impratio_invsqrt[world % impratio_invsqrt.shape[0]]
            dm = math.safe_div(D[world, normal], mu * mu * (1.0 + mu * mu))
            tt = float(0.0)
            sum1 = float(0.0)
            sum2 = float(0.0)
            dot = float(0.0)
            for k in range(1, condim[contact]):
                row = efc_address[contact, k]
                if row >= 0:
                    u = Jaref[world, row] * scales[k - 1]
                    z1 = scales[k - 1] * J[world, row, one]
                    z2 = scales[k - 1] * J[world, row, two]
                    tt += u * u
                    sum1 += u * z1
                    sum2 += u * z2
                    dot += z1 * z2
            inverse = math.safe_div(1.0, wp.max(wp.sqrt(tt), types.MJ_MINVAL))
            ratio = mu * Jaref[world, normal] * mu * inverse
            z01, z02 = mu * J[world, normal, one], mu * J[world, normal, two]
            total += solver._elliptic_hessian_entry_from_projections(
                dm, mu, ratio, mu * mu - ratio, z01, z02, sum1 * inverse, sum2 * inverse, dot
            )
        h[world, one, two] = h[world, one, two] + total


# fmt: off
@wp.kernel(module="unique", enable_backward=False)  # Its blocks have another size, so that it needs its own module.
def _sort_matches(
    sensor_intprm: Ints2, sensor_adr: Ints, nmatch: Ints2, match: Ints3, criterion: Floats3, match_out: Ints3,
) -> None:
    # fmt: on
    """Sort the contacts of a sensor in place, by the sensor's criterion and then by the order of the contacts.

    ``match_out`` is ``match``. The complement of a contact's number means a contact in the other direction.
    """
    world, own, lane = wp.tid()
    if lane > 0:
        return
    for i in range(1, wp.min(nmatch[world, own], match.shape[2])):
        for k in range(i):
            b = i - k
            x, y = float(criterion[world, own, b - 1]), float(criterion[world, own, b])
            one, two = int(match[world, own, b - 1]), int(match[world, own, b])
            if not (x > y or (x == y and wp.max(one, ~one) > wp.max(two, ~two))):
                break
            criterion[world, own, b - 1] = y
            criterion[world, own, b] = x
            match_out[world, own, b - 1] = two
            match_out[world, own, b] = one


def _sort_constraints(m: Any, d: Any) -> None:
    """Sort the rows of equalities, friction, and limits by type and object; the rows of contacts are already sorted."""
    rows = [getattr(d.efc, name) for name in _ROW_FIELDS]
    wp.launch(_sort_rows, dim=d.nworld, inputs=[d.ne, d.nf, d.nl, d.njmax, m.nv, *rows])


@wp.func
def _swap(values: wp.array2d[Any], world: int, a: int, b: int):  # type: ignore[no-untyped-def]  # noqa: ANN202
    value = values.dtype(values[world, a])
    values[world, a] = values[world, b]
    values[world, b] = value


# fmt: off
@wp.kernel
def _sort_rows(
    ne: Ints, nf: Ints, nl: Ints, njmax: int, nv: int, kind: Ints2, number: Ints2, pos: Floats2, margin: Floats2,
    D: Floats2, vel: Floats2, aref: Floats2, frictionloss: Floats2, J: Floats3,
) -> None:
    # fmt: on
    """Sort the rows of one simulation by insertion; several rows of one object keep their order."""
    world = wp.tid()
    for i in range(1, wp.min(ne[world] + nf[world] + nl[world], njmax)):
        for k in range(i):
            b = i - k
            a = b - 1
            one, two = kind[world, a], kind[world, b]
            if one < two or (one == two and number[world, a] <= number[world, b]):
                break
            _swap(kind, world, a, b)
            _swap(number, world, a, b)
            _swap(pos, world, a, b)
            _swap(margin, world, a, b)
            _swap(D, world, a, b)
            _swap(vel, world, a, b)
            _swap(aref, world, a, b)
            _swap(frictionloss, world, a, b)
            for dof in range(nv):
                value = float(J[world, a, dof])
                J[world, a, dof] = J[world, b, dof]
                J[world, b, dof] = value
