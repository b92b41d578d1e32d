"""Animate films of episodes: the first success of each file, all cameras side by side.

usage: python -m benchmarks.films EPISODES.h5 ... -o OUT.webp"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Annotated

import av
import numpy as np
import typer
from PIL import Image

from graspd.service.store.shards import read_shard
from graspd.worker.episodes.episode import EpisodeOutcome
from graspd.worker.episodes.shard import episodes_of_shard

#: Size of a camera's picture [px], and frames of a film for each picture of the animation.
SIZE, EVERY = (224, 168), 3


def main(
    files: Annotated[list[Path], typer.Argument(help="Filmed episodes.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="WebP file to write.")],
) -> None:
    """Write one animation of all files."""
    pictures = []
    for file in files:
        shard = read_shard(file, kind="episodes")
        shown = next(one for one in episodes_of_shard(shard) if one.outcome is EpisodeOutcome.SUCCEEDED)
        films = [av.open(io.BytesIO(film)).decode(video=0) for film in shown.videos.values()]
        for number, frames in enumerate(zip(*films, strict=True)):
            if number % EVERY == 0:
                small = [np.asarray(frame.to_image().resize(SIZE, Image.Resampling.LANCZOS)) for frame in frames]
                pictures.append(Image.fromarray(np.hstack(small)))
    milliseconds = round(1000 * EVERY / float(shard.attributes["fps"]))  # type: ignore[arg-type]
    first, *others = pictures
    first.save(output, save_all=True, append_images=others, duration=milliseconds, loop=0, quality=60, method=6)


if __name__ == "__main__":
    typer.run(main)
