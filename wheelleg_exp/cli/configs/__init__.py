"""The commands that look at configs and simulate nothing.

| module | offers |
|---|---|
| ``compose``, ``explain``, ``diff`` | what a config holds, who set it, in what two differ |
| ``check``, ``doctor`` | mistakes in it, and numbers and robots that make no sense |
"""
