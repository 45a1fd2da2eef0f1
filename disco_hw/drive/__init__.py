"""Driving by hand or by script, through the daemon's own loop."""
