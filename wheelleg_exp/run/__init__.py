"""The run directory: one folder that records how a policy was produced, and shows whether a file has changed.

| module | offers |
|---|---|
| ``run_directory`` | the config section ``run``, and the paths of run directories and of their files |
| ``start_run`` | the files that are written before the first step |
| ``manifest``, ``file_inventory`` | ``manifest.json``: status, versions, results, and the digest of every file |
| ``run_config`` | parameters, config, overrides, and robot of a run, read back |
| ``iteration_log`` | ``iterations.jsonl``, read back |
| ``environment`` | distributions, hardware, and the variables that change numbers |
| ``source_snapshot``, ``source_restore``, ``source_changes`` | the source of a run: stored, restored, and compared |
| ``git_commands`` | git commands that change nothing |
| ``run_list``, ``run_index`` | all runs of a folder, and the indexes of sweeps and pipelines |
| ``run_lock``, ``timestamps`` | one writer at a time; times in the manifest and in names |
"""
