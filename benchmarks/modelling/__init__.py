"""What graspd leaves out, priced: the cost of modelling it and what it would change (docs/explanation/modelling.md)."""
