"""Evaluation of episodes: metrics, tables and images."""
