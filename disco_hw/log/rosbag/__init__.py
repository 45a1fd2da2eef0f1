"""Bags of ROS 2 and ROS 1 -> the arrays of a drive, and a drive -> a bag, without a ROS installation."""
