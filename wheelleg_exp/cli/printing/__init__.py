"""Print to a terminal or a pipe.

| module | contents |
|---|---|
| `terminal` | streams whose readers can disappear; text and tables that fit the screen |
| `progress_display` | the progress of a job or a sweep |
| `figures_table`, `evaluation_tables` | figures of plays and agents; metrics of evaluations |
| `inspection_tables`, `conversion_summary` | the contents of a recording; the result of a conversion |
"""
