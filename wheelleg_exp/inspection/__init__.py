"""Questions to recordings: summaries, statistics, tables, plots, pictures, and the viewer.

| module | offers |
|---|---|
| ``questions`` | what is asked in numbers |
| ``plots`` | figures |
| ``pictures`` | pictures and videos of the robot |
| ``viewer`` | rerun's viewer |
"""
