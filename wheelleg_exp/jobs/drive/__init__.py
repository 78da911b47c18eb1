"""A trained robot that is driven: by hand in the browser, or by a script without one.

``axes`` is what may be commanded, ``controls`` what is asked for, by whom it may be, ``script`` a file of it;
``session`` takes one control step after the other, ``drive`` is the job around it, and ``page`` what a browser shows.
"""
