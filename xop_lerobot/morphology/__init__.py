"""Robots: models, command space, tracked frames, contacts and planner parameters."""
