"""The verbs of the command `disco-hw`, grouped by whom they serve: each parses its arguments and calls one function.

Verbs import what they need when they run, so that `estop` and `--help` need nothing else to be healthy.
"""
