"""Benchmarks of the project, `python -m benchmarks.run_…`; not part of the installed package."""
