"""Writing to rerun, reading recordings back, blueprints and digests."""

import os

# Read by rerun when it is imported. A growing file has no index on purpose, of which rerun would warn each time.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding::rrd::file_sink=error")
