"""Several trainings from one command line, each in a process of its own, and their index.

| module | offers |
|---|---|
| ``sweep`` | runs the jobs, a fixed number at once, and keeps the index up to date |
| ``job`` | one of them, inside its process |
"""
