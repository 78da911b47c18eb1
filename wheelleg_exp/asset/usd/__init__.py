"""Read robots from USD with the schemas of UsdPhysics, PhysX, Newton, and MuJoCo; report physics that was not read."""
