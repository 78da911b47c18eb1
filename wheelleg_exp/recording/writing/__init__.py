"""Record environments to a growing Rerun file, without an effect on the simulation.

| module | offers |
|---|---|
| ``recorder`` | ``Recorder``: the file and its environments |
| ``recorded_environment``, ``recorded_frames``, ``recorded_events`` | one environment, its frames, its events |
| ``rerun_shapes`` | geoms, poses, arrows and the ground as Rerun's shapes |
| ``recording_file``, ``resume_recording`` | the growing file, and the rows of an earlier file |
| ``live_view`` | a viewer that follows the file |
"""
