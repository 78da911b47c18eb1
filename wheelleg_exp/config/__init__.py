"""Composing, provenance, checking and listing of the configuration; free of torch and MuJoCo until it checks.

``compose.compose`` makes a config, ``check.check`` finds its mistakes, ``catalog`` says what there is.
"""
