"""Recordings for Rerun: the contents of a recording, how it grows, and how it is read back.

| module | offers |
|---|---|
| ``layout`` | the entity paths of a recording |
| ``blueprint`` | the layout of the viewer |
| ``rrd_file``, ``rerun_program`` | the messages of an rrd file, and Rerun's command-line program |
| ``writing``, ``reading`` | from the environment into a file, and back |
"""

import os

# At its import, Rerun reads the environment variable RUST_LOG.
# A recording has no index until it is closed, and Rerun would warn about each recording without an index.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
