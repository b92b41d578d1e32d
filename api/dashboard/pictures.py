"""Thumbnails of rendered views: one picture of a views shard as a PNG."""

from __future__ import annotations

import io
from functools import lru_cache

import h5py
import numpy as np
from PIL import Image

from service.errors import NotFoundError
from service.store import Store

#: A views shard of 48 pictures is a few megabytes; a page asks for several pictures of the same one.
_KEPT_SHARDS = 2


class Pictures:
    """Decodes pictures of views shards; keeps the shards it read last."""

    def __init__(self, store: Store) -> None:
        self._fetch = lru_cache(maxsize=_KEPT_SHARDS)(store.get)

    def png(self, key: str, index: int) -> bytes:
        """PNG of the colour picture at row `index` of /image/rgb (V, H, W, 3).

        Raises:
            NotFoundError: the shard holds fewer pictures.
        """
        with h5py.File(io.BytesIO(self._fetch(key)), "r") as file:
            if "image/rgb" not in file:
                raise NotFoundError("the shard holds no pictures; only a views shard does")
            pictures = file["image/rgb"]
            if not 0 <= index < len(pictures):
                raise NotFoundError(f"the shard holds {len(pictures)} pictures; there is no picture {index}")
            pixels = np.asarray(pictures[index])
        buffer = io.BytesIO()
        Image.fromarray(pixels).save(buffer, "PNG", compress_level=3)
        return buffer.getvalue()
