"""What a person runs to see the whole at work: demo, experiments, and the daemon in simulated time."""
