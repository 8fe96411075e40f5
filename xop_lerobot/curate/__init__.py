"""Curation of recorded datasets: the verbs of `xop-curate`, and what they share.

`source` streams a dataset, `transfer` writes a new one, `destination` puts it in place, and `cli`
lists the verbs.
"""
