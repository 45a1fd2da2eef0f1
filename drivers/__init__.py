"""What talks to hardware: transports and one driver for each motor controller."""
