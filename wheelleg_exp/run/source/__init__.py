"""The source of a run: a commit, a tree id and a patch, kept without touching the working tree, and restored.

| module | offers |
|---|---|
| ``snapshot`` | the record ``source/git.json`` and its patches |
| ``worktree``, ``git`` | what of a working tree is kept, asked of git without changing it |
| ``installed`` | a package that was installed rather than worked on |
| ``secrecy`` | what must not get into a run directory: keys, tokens, credentials |
| ``restore`` | the source tree again, from the commit and the patch |
| ``description`` | what is kept, in words for the console |
"""
