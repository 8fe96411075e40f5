"""Changing settings at runtime: a local socket, its client, and terminal keys."""
