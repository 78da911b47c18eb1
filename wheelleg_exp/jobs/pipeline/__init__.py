"""Pipelines: several tasks one after the other, each starting with the policy of the previous one, with gates between.

| module | offers |
|---|---|
| ``pipeline_phases`` | the options of phases and gates, and whether an evaluation passes a gate |
| ``pipeline_settings`` | a composed pipeline, checked before its first phase starts |
| ``run_pipeline`` | running the phases |
| ``resume_pipeline`` | resuming a pipeline |
"""
