"""The engine on mujoco-warp: simulations on a GPU, or on Warp's CPU device, in float32.

| module | what it offers |
|---|---|
| `engine` | the engine: its step, resets, rays and state |
| `fields` | MuJoCo's fields as tensors, with one value a simulation where that is asked for |
| `graphs` | work that is launched as one CUDA graph |
| `room` | how many contacts and constraint rows there is room for, and the error when there are more |
| `kernels` | what the engine does to its state beside the physics |
| `library` | mujoco-warp itself, imported when the engine is chosen |
"""
