"""What is asked of a recording in numbers.

| module | offers |
|---|---|
| ``target``, ``view``, ``selection``, ``spans`` | which recording, and which rows and frames of it |
| ``columns``, ``statistics`` | numbers by name, and their statistics |
| ``conditions``, ``query`` | when a condition holds |
| ``measures``, ``episodes``, ``trends`` | the robot, its episodes, its training |
| ``summary`` | what one wants to know first |
| ``compare`` | two recordings side by side |
| ``export`` | Parquet and CSV |
"""
