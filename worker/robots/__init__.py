"""Grasps as a robot carries them out: their postures, a frame of the user's choice, times, the arm."""
