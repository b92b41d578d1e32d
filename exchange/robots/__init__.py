"""Grasps for robots and their simulators: MuJoCo, USD, glTF, MoveIt, Isaac Sim, CSV."""
