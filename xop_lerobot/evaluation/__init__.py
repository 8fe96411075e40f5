"""Evaluation: trials with a simulated person, their metrics, tables and reports."""
