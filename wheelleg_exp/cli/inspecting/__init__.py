"""The actions of ``wheelleg inspect``, and how they print what they find.

| module | offers |
|---|---|
| ``action`` | what the actions share |
| ``reading``, ``pictures`` | actions that read; actions that make files, pictures and windows |
| ``summary``, ``rows`` | how it is printed |
"""
