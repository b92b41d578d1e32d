"""Dataset cards: content, provenance, quality and bias of a dataset, all computed from its shards.

contents.py finds the dataset and opens its shards one by one; tally.py sums them. numbers.py computes the figures of
`card.json`; findings.py reports anomalies. plots.py makes the plots, page.py and page.md.j2 the page."""
