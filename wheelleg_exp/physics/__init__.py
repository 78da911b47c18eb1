"""Looks at the numbers of a config as an expert would before training: facts of the robot, and rules that use them.

``report.examine`` does it all; each rule is a small function of a ``Case``, found by its name in ``rules.RULES``.
"""
