"""`xop-doctor`: checks whether this machine is ready, and advises."""
