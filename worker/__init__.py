"""The engine: hands, objects, simulation, planners, quality, scenes, rendering, and the stages that run them."""
