"""Drivers that talk to hardware: transports, pose sources, and one driver for each motor controller."""
