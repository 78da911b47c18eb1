"""N simulations on MuJoCo: scene assembly, robot state, actuators and contact sensing.

| module | what it offers |
|---|---|
| `engine`, `batch` | what a scene asks of an engine, and MuJoCo's own |
| `scene`, `robot_spec` | ground, robot and sensors in one model; the robot's file in it |
| `robot`, `layout`, `data` | the robot: writing it, what is fixed, its state |
| `actuators` | joint targets become controls |
| `sensors`, `terrain` | members of the scene, also a user's own |
| `options` | what may stand in `env.sim`, `env.scene` and `env.robot` |
| `names`, `rotation`, `ids`, `delay` | expressions, quaternions, masks, late samples |
"""
