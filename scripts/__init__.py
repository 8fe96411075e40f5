"""Programs of the project by itself; not installed."""
