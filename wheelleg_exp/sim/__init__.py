"""N simulations of one scene on MuJoCo: scene assembly, robot, actuators, sensors, and terrain.

| module | what it offers |
|---|---|
| `engine`, `batch_engine`, `warp_engine` | the interface of an engine, MuJoCo on the CPU, mujoco-warp on a GPU |
| `warp_fields`, `warp_kernels`, `warp_runtime` | parts of the engine `warp` |
| `scene`, `robot_model` | ground, robot and sensors in one model; the robot's part of it |
| `robot`, `robot_writers` | the robot, and the methods that write its state, parameters and targets |
| `robot_data`, `articulation_data`, `class_members` | the robot's state under Isaac Lab's names |
| `actuators`, `sensors`, `terrain` | members of the scene, stock or user-defined |
| `options` | the keys of `env.sim`, `env.scene` and `env.robot` |
| `names`, `rotation`, `ids` | name expressions, quaternions, indices |
| `delay`, `timers`, `static_rays` | delayed samples, countdown timers on a GPU, rays to the ground on the CPU |
"""
