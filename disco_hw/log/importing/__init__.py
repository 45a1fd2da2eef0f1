"""Foreign logs -> our MCAP log."""
