"""How well an episode went: figures, tables and pictures."""
