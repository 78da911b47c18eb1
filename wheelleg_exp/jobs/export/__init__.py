"""A trained policy as a deployer takes it: one folder that runs without this package.

| module | offers |
|---|---|
| ``export`` | makes the bundle of a run, whole or not at all, and holds it against the simulation that trained it |
| ``specification`` | ``policy.json``, made of ``readings``, ``observations``, ``actions``, ``drives``, ``network`` |
| ``deployment`` | the run's environment without what the world adds |
| ``recorded`` | episodes to hold a runner against |
| ``onnx_metadata``, ``readme`` | the same for ONNX runtimes, and for people |
| ``bundle`` | the files that a bundle takes as they stand |
"""
