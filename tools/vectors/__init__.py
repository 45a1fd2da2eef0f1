"""Comparison of vendors' protocol test vectors with this project's codec and simulator; one file a vendor."""
