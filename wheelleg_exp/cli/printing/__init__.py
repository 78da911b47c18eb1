"""Print text, tables, and progress to a terminal or a pipe.

| module | contents |
|---|---|
| `terminal` | streams whose readers can disappear; paths, text and tables that fit the screen |
| `progress_display` | the progress of a job or a sweep |
| `metric_tables` | figures of plays and agents; metrics of evaluations |
| `inspection_tables` | the contents of a recording |
"""
