"""DISCO on hardware: estimation, control, daemon, logging and tools for a skid-steer robot."""
