"""Inference of the robot's parameters from a logged drive (BayesSim)."""
