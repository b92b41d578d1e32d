"""Dataset cards: what a dataset holds, how it was made, how good and how biased it is, all computed from its shards.

contents.py finds the dataset and opens its shards one by one, tally.py adds them up, numbers.py makes the
figures of `card.json` of the sums, findings.py says what stands out, plots.py and page.py show it.
"""
