"""Cost and influence of effects that graspd does not model (docs/explanation/modelling.md)."""
