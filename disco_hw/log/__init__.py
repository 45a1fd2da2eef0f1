"""Logs: what is recorded, how it gets to the disk without disturbing the loop, and how it is read again."""
