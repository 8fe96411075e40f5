"""Measurements of the project by itself: `python -m benchmarks.run_…`; not installed."""
