"""Reading and writing of grasp files: graspd's own and foreign ones."""
