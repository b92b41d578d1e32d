"""A network that sees an object and proposes Barrett grasps: what a dataset of grasps is worth. See README.md."""
