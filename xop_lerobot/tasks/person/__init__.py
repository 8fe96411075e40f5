"""Simulated headset operator: delayed and noisy perception, human motion, corrections."""
