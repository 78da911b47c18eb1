"""Pipelines: several tasks in order, each starting with the policy of the previous task, with gates in between."""
