"""Curation of recorded datasets: `xop-curate` and what its verbs share.

`source` streams a dataset, `destination` puts a new one in place, `verbs` lists the verbs.
"""
