"""Write a USD of a URDF for docs/arena.md: ``python usd_of_urdf.py ROBOT.urdf FOLDER [PACKAGE=PATH ...]``.

The conversion is urdf-usd-converter's. PhysX gives a body without a mass 1 kg, or its colliders' volume times 1,000
kg/m³; links without an inertial get 1 mg here, and therefore weigh nothing in both engines. PhysX only filters the
collisions of two links with a joint between them; as in MuJoCo, the links fixed to these do not collide here either.
"""

import sys
from itertools import product

from pxr import Gf, Usd, UsdPhysics
from urdf_usd_converter import Converter

robot, folder, *packages = sys.argv[1:]
named = [dict(zip(("name", "path"), word.split("="), strict=True)) for word in packages]
asset = Converter(layer_structure=False, scene=False, ros_packages=named).convert(robot, folder)
stage = Usd.Stage.Open(asset.path)
for prim in stage.Traverse():
    if prim.HasAPI(UsdPhysics.RigidBodyAPI) and not UsdPhysics.MassAPI(prim).GetMassAttr().Get():
        mass = UsdPhysics.MassAPI.Apply(prim)
        mass.CreateMassAttr(1e-6)
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(1e-9))
        mass.CreatePrincipalAxesAttr(Gf.Quatf(1.0))
        mass.CreateCenterOfMassAttr(Gf.Vec3f(0.0))
joints = [UsdPhysics.Joint(prim) for prim in stage.Traverse() if prim.IsA(UsdPhysics.Joint)]
ends = [(*joint.GetBody0Rel().GetTargets(), *joint.GetBody1Rel().GetTargets()) for joint in joints]
welded = {path: {path} for pair in ends for path in pair}
for joint, (parent, child) in zip(joints, ends, strict=True):
    if joint.GetPrim().IsA(UsdPhysics.FixedJoint):
        both = welded[parent] | welded[child]
        welded |= dict.fromkeys(both, both)
for parent, child in ends:
    for one, other in product(welded[parent], welded[child]):
        pair = [stage.GetPrimAtPath(path) for path in (one, other)]
        if one != other and all(body.HasAPI(UsdPhysics.RigidBodyAPI) for body in pair):
            UsdPhysics.FilteredPairsAPI.Apply(pair[0]).CreateFilteredPairsRel().AddTarget(other)
stage.Save()
