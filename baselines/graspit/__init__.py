"""GraspIt!'s eigengrasp planner (Ciocarlie & Allen 2009): simulated annealing in posture and pose, then autograsp."""
