"""Read a Rerun recording as tables, even if the recording's file is damaged.

| module | offers |
|---|---|
| ``recording_reader`` | ``Recording``: rows, numbers by name and in groups, events, documents, properties |
| ``recording_contents``, ``arrow_values`` | the rows of a file, and Arrow values as Python values |
| ``recording_digest`` | a digest of the content |
| ``recording_repair`` | a readable copy of a damaged file |
"""
