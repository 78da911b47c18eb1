"""The run directory: one folder that says what produced a policy, and that it is still what it was.

| module | offers |
|---|---|
| ``options`` | what may stand under ``run.`` in the config |
| ``directory`` | making, finding and naming run directories, and the paths inside one |
| ``begin`` | what is written before the first step: parameters, config, source, environment, manifest |
| ``manifest``, ``manifest_format``, ``seal`` | ``manifest.json``: status, versions, digests, results |
| ``params`` | ``params/{env,agent}.yaml``, written and read back |
| ``recorded`` | what a run has kept, read back: config, overrides, robot, source, installed distributions |
| ``log`` | ``iterations.jsonl`` read back |
| ``environment`` | installed distributions, hardware, and the variables that change numbers, here and in a replay |
| ``inventory``, ``kinds`` | sha256 and size of the files of a run; whether a value that was read has its shape |
| ``lock``, ``process`` | one writer at a time; whether a recorded process still lives |
| ``listing``, ``sweep_index``, ``timestamps`` | all the runs there are, the sweeps among them, and when they began |
| ``source``, ``source_changes`` | the state of the source tree, kept and restored; which files differ between two |
"""
