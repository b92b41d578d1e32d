"""`graspd chart`: speed against accuracy of methods and fidelities on the same hands and objects."""
