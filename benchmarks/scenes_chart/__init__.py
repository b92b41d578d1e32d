"""Grasps planned in scenes, compared with filtered free grasps (docs/results/scenes-chart/chart.md)."""
