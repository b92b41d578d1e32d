"""The engine: hands, objects, simulation, planners, quality, scenes, rendering and worker stages."""
