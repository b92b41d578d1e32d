"""Grasps as robots and their simulators read them: MuJoCo, USD, glTF, MoveIt, Isaac Sim, CSV."""
