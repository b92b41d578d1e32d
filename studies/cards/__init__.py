"""Dataset cards: content, provenance, quality and bias of a dataset, all computed from its shards.

contents.py reads the shards, tally.py sums them, and numbers.py computes `card.json`. plots.py, page.py, findings.md.j2
and page.md.j2 make the page."""
