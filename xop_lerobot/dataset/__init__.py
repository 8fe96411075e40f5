"""Datasets: columns, recording in LeRobot's commands, durability. LeRobot is imported here alone."""
