"""Run the console script ``wheelleg``. Each command of ``wheelleg`` is one module of the package ``cli``.

| module | contents |
|---|---|
| `main` | finds the command, imports only its module, returns the exit status |
| `arguments`, `completion` | the parser and shared options; completion in the shell |
| `train`, `resume`, `replay`, `agents` | commands that train or run a task |
| `play`, `evaluate`, `results`, `export` | commands that use a policy |
| `configs`, `list`, `new` | commands on configs and projects |
| `convert`, `inspect`, `verify`, `report` | commands that read robots, recordings and runs |
| `printing` | tables and progress in a terminal |
"""
