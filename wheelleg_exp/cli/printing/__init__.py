"""How things look in a terminal, and in what is piped.

| module | offers |
|---|---|
| ``streams`` | standard output and error, whose readers may go away |
| ``tables`` | text that fits the screen |
| ``display``, ``sweep_display``, ``outcome`` | a job as it goes, and how it ended |
| ``figures``, ``conversion`` | what a rollout, or a conversion, came to |
"""
