"""Adaptation: the geometry learnt again while the robot drives, checked, and given to planner and estimator."""
