"""Tables of results: what runs and protocols they are of, and whether they come out again.

| module | what it offers |
|---|---|
| `record` | a comparison of evaluated runs becomes `NAME.json`, `NAME.md` and the runs' manifests |
| `page` | the table as Markdown |
| `again` | trains and evaluates what a record names once more, and compares to the bit |
"""
