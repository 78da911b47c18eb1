"""The run directory: one folder that says what produced a policy, and that it is still what it was.

| module | owns |
|---|---|
| ``options`` | what may stand under ``run.`` in the config |
| ``directory`` | making, finding and naming run directories, and the paths inside one |
| ``snapshot`` | what is written before the first step: parameters, config, source, environment, manifest |
| ``manifest`` | ``manifest.json``: status, versions, hardware, digests, results, later additions |
| ``params`` | ``params/{env,agent}.yaml``, written and read back |
| ``source`` | the state of the source tree as a commit, a tree id and a patch |
| ``worktree``, ``git``, ``secrecy`` | what of a working tree is kept, read without touching it |
| ``restore`` | the source tree again, from the commit and the patch |
| ``plain_yaml``, ``timestamps`` | values and times that read back equal |
| ``environment`` | installed distributions, hardware, and the variables that change numbers |
| ``inventory`` | sha256 and size of the files of a run, and how they differ from what was recorded |
| ``files`` | writing a file whole or not at all |
| ``lock``, ``process`` | one writer at a time; whether a recorded process still lives |
| ``listing`` | all the runs there are |
"""
