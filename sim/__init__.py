"""What replaces the robot: plant, mock CAN bus, virtual robot."""
