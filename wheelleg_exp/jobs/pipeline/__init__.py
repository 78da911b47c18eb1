"""Several tasks one after the other, each from the policy of the one before, with gates between.

| module | offers |
|---|---|
| ``options`` | what a config may say of a pipeline, its phases and their gates |
| ``settings`` | the declared pipeline: its phases, composed and held against each other |
| ``gate`` | whether an evaluation passes a gate |
| ``metric_names`` | whether the gates ask for metrics that there are |
| ``pipeline`` | runs the phases, and keeps the record up to date |
| ``job`` | going on with a run, and evaluating it, each in a process of its own |
| ``child`` | the end of the process that has started a job |
"""
