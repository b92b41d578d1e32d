"""Camera views of scenes, and pictures of grasps for users."""

from graspd.worker.rendering.views import Extras, render

__all__ = ["Extras", "render"]
