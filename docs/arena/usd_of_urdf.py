"""Write a USD of a URDF for docs/arena.md: ``python usd_of_urdf.py ROBOT.urdf FOLDER [PACKAGE=PATH ...]``.

The conversion is urdf-usd-converter's. PhysX gives a body without a mass 1 kg, or its colliders' volume times 1,000
kg/m³; links without an inertial get 1 mg here, and therefore weigh nothing in both engines.
"""

import sys

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
stage.Save()
