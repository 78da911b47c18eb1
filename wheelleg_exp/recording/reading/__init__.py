"""A recording read back as tables, damaged ones as far as they go.

| module | offers |
|---|---|
| ``reader``, ``groups``, ``statics``, ``events``, ``journal`` | what it holds: numbers, facts, words, curves |
| ``contents``, ``rows``, ``components``, ``plain`` | rows by entity, and Arrow's values as Python's own |
| ``messages`` | the format of a file |
| ``health``, ``repair`` | how whole a file is, and mending it |
| ``digest`` | the same for every run that did the same |
"""
