"""Nouns that every part uses; it imports nothing of the others."""
