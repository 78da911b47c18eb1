"""Pictures of bodies and shapes, drawn by MuJoCo in a child process.

| module | offers |
|---|---|
| ``render_scene`` | shapes, the scene, and the camera's place |
| ``scene_models`` | scene of a compiled model, poses of its bodies, and the MuJoCo model of a scene |
| ``renderer``, ``render_job`` | the child process that draws, and its parent's side |
| ``camera_job`` | the child process that draws the pictures of camera sensors |
| ``live_pictures`` | pictures of running simulations, and of camera sensors |
| ``video_file`` | pictures encoded as a video file |
"""
