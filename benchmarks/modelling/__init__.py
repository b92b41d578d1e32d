"""What graspd leaves out, priced: what modelling it would cost and what it would change (docs/modelling.md)."""
