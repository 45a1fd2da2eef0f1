"""Processes of their own that carry the daemon's state to other worlds, and their poses and commands to it."""
