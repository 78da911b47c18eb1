"""Pictures of bodies and shapes, drawn by MuJoCo in a process of its own.

| module | offers |
|---|---|
| ``shapes``, ``scene``, ``viewpoint`` | what is drawn, and from where it is seen |
| ``compiled``, ``poses`` | the scene of a compiled model, and where its bodies are |
| ``renderer``, ``render_job``, ``render_model`` | the process that draws, seen from both sides, and its model |
| ``camera_job``, ``camera_pictures`` | what a camera of a compiled model sees, from both sides of such a process |
| ``limits`` | how many environments may be drawn |
| ``film`` | pictures into a video file |
| ``live`` | pictures of simulations as they run |
"""
