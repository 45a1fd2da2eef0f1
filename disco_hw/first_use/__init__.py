"""The first hour with a robot: what its robot.toml must say, and whether it does what it is told."""
