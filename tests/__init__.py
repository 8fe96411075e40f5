"""Tests, in the folders of what they test; `helpers` has what they share."""
