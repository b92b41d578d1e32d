"""What a camera sees of a scene, and pictures of grasps for people."""

from __future__ import annotations

from graspd.worker.rendering.views import Extras, render

__all__ = ["Extras", "render"]
