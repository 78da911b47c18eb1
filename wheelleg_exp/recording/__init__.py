"""Recordings for rerun: what a recording contains, how it grows, and how it is read back.

| module | offers |
|---|---|
| ``layout`` | the entity paths of a recording |
| ``blueprint`` | the layout of the viewer |
| ``recording_options`` | the config section ``recording``, and the choice of the recorded episodes |
| ``rrd_file``, ``rerun_program`` | the frame of an rrd file, and rerun's command-line program |
| ``writing``, ``reading`` | from the environment into a file, and back |
"""

import os

# rerun reads the variable at its import. A growing file has no index on purpose; rerun would warn of it each time.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
