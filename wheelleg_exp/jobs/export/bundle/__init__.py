"""Files that are copied into a bundle: they run without this package and need NumPy, and MuJoCo to simulate.

| module | what it is in a bundle |
|---|---|
| ``runner`` | the policy: from sensor readings to joint targets |
| ``simulate`` | the robot in MuJoCo, driven by the runner |
"""
