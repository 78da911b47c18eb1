"""From the environment into a growing rerun file, without touching what is recorded.

| module | offers |
|---|---|
| ``recorder``, ``track`` | the file and the environments in it |
| ``channels``, ``channels_learning``, ``frames`` | what one frame holds, and frames in a row |
| ``drawing``, ``geometry``, ``kinematics`` | numbers as columns, shapes of the model, poses of its bodies |
| ``facts``, ``scalars``, ``marks`` | properties, training curves, marked moments and words |
| ``sink``, ``encoding``, ``finishing``, ``size`` | the file as it grows, its messages, its end, its bound |
| ``continuing``, ``kept_copy`` | what an earlier recording keeps when a run goes on |
| ``live``, ``feed`` | a viewer that follows the file |
"""
