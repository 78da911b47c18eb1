"""Pictures and videos of the robot, drawn by MuJoCo in a process of its own from what was recorded.

| module | offers |
|---|---|
| ``pictures``, ``video`` | what is asked for: pictures at moments, a film of a span |
| ``recorded_scene``, ``recorded_shapes`` | the scene of a recording as plain arrays |
| ``robot_picture`` | a robot as it begins, of which nothing was recorded |
| ``camera``, ``captions`` | where it is seen from, and what is written into it |
"""
