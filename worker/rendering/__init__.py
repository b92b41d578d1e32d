"""Camera views of scenes, and pictures of grasps for users."""

from __future__ import annotations

from graspd.worker.rendering.views import Extras, render

__all__ = ["Extras", "render"]
