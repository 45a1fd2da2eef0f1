"""The real-time shell of disco-hw: clocks, the loop, the daemon's states, limits, and its local control socket."""
