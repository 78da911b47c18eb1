"""Rerun's viewer on a recording, on the loopback address alone.

| module | offers |
|---|---|
| ``viewer`` | in a window, in a browser, or as a picture of it |
| ``viewer_process`` | rerun's own program |
| ``web`` | rerun's web viewer with one recording in it |
"""
