"""Datasets: extra columns, recording in LeRobot's commands, and durability."""
