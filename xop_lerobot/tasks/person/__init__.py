"""A simulated person in the headset: delayed, noisy perception, human motion, corrections."""
