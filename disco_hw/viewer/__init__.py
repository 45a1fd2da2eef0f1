"""The page: the robot, its task and why it does what it does, live from the daemon and from a recorded log."""
