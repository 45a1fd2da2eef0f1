"""What kinds of tasks share that follow a line of way-points: its table, course, progress and cost, and their file."""
