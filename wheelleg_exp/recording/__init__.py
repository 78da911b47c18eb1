"""Recordings for rerun: what one holds, how it grows while the environment steps, and how it is read back.

| module | offers |
|---|---|
| ``layout`` | where things stand in a recording |
| ``blueprint`` | what the viewer shows |
| ``options``, ``sample`` | its config ``recording.``, and which episodes of a training are kept |
| ``programs`` | where rerun's own program is |
| ``writing``, ``reading`` | from the environment into a file, and back |
"""

import os

# Read by rerun when it is imported. A growing file has no index on purpose, of which rerun would warn each time.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
