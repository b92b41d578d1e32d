"""GraspIt!'s eigengrasp planner (Ciocarlie & Allen 2009): simulated annealing, then autograsp."""
