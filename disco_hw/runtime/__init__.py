"""One tick of the robot, without a clock, a thread or a file: pipeline, supervisor, governor, plausibility."""
