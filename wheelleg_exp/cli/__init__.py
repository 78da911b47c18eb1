"""The console script ``wheelleg``: one module a command, with the command's name; only here is anything printed.

| module | offers |
|---|---|
| ``main`` | finds the command, imports its module alone, returns the exit status |
| ``common``, ``completion`` | what the commands share; completion in the shell |
| ``train``, ``resume``, ``sweep``, ``replay``, ``play``, ``agents``, ``evaluate`` | commands that run |
| ``configs``, ``list``, ``list_runs``, ``new`` | commands on configs and projects |
| ``convert``, ``inspect``, ``verify``, ``report`` | commands that look |
| ``inspecting``, ``printing`` | the actions of ``inspect``; how things look in a terminal |
"""
