"""BayesSim: what a logged drive says about the robot's parameters."""
