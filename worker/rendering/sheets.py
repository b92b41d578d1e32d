"""Pages of pictures with text: best grasps with figures, grasps from three sides, views of a shard."""

import io
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from graspd.service.model.transforms import Floats, compose
from graspd.service.readers.trajectories import wrist_angles
from graspd.service.store import validity
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.service.store.shards import Shard
from graspd.worker.hands.model import HandModel
from graspd.worker.rendering.annotate import OBJECT, TABLE
from graspd.worker.rendering.hands import DrawnHand

MARGIN: Final = 40
GAP: Final = 18
_HEAD: Final = 74
_CAPTION: Final = 44
_NAME: Final = 22
_SEGMENT: Final = np.array(
    [[214, 216, 219], [150, 168, 178], [224, 129, 63], [96, 122, 158], [122, 158, 112], [168, 118, 150]], np.uint8
)
_TIGHT: Final = (0, 214, 190)
_LOOSE: Final = (255, 255, 255)
_BOX_3D: Final = (255, 205, 60)
_EDGES: Final = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]

Arrays = Mapping[str, NDArray[np.generic]]


def best_rows(quality: Arrays, count: int, among: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the `count` best rows by epsilon among those of a mask (N,)."""
    rows = np.flatnonzero(among)
    return rows[np.argsort(-metric_at_threshold(quality, "quality/epsilon")[rows], kind="stable")][:count]


def best_transferred_rows(scene: Arrays, base: Arrays) -> NDArray[np.int32]:
    """Return the row (S,) of each scene's valid grasp with the largest epsilon; -1 if it has none."""
    epsilon = metric_at_threshold(base, "quality/epsilon")[np.asarray(scene["grasp/base_index"])]
    return _best_of_scenes(scene, np.where(np.asarray(scene["grasp/valid"], bool), epsilon, -np.inf))


def best_in_scenes(base: Arrays, among: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the row (S,) of each scene with the largest epsilon among a mask (N,); -1 if it has none."""
    epsilon = np.nan_to_num(metric_at_threshold(base, "quality/epsilon"), nan=-1.0)
    return _best_of_scenes(base, np.where(among, epsilon, -np.inf))


def best_grasps_drawn(base: Shard, hand: HandModel, *, unvalidated: bool) -> DrawnHand | None:
    """Return the best valid or, if `unvalidated`, feasible grasp of each scene; None without grasps."""
    among = validity.selection_mask(base.arrays, unvalidated=unvalidated)
    if not len(among):
        return None
    rows = best_in_scenes(base.arrays, among)
    poses, joints = (np.asarray(base[f"grasp/{name}"], float)[rows] for name in ("hand_pose", "joint_positions"))
    placed = compose(np.asarray(base["scene/object_pose"], float), poses)
    return DrawnHand(hand, rows, placed, joints, wrist_angles(base, rows))


def _best_of_scenes(columns: Arrays, score: Floats) -> NDArray[np.int32]:
    rows = np.full(len(columns["scene/object_pose"]), -1, np.int32)
    for s in range(len(rows)):
        mine = np.flatnonzero(np.asarray(columns["grasp/scene_index"]) == s)
        if len(mine) and np.isfinite(score[mine]).any():
            rows[s] = mine[np.argmax(score[mine])]
    return rows


def caption_entries(quality: Arrays, rows: NDArray[np.intp]) -> list[list[tuple[str, str]]]:
    """Return caption entries, label and value, for each row of a base shard."""
    epsilon, area = (metric_at_threshold(quality, f"quality/{name}") for name in ("epsilon", "contact_area_cm2"))
    depth = np.asarray(quality["quality/penetration_depth_mm"], float)
    return [
        [("epsilon", f"{epsilon[r]:.3f}"), ("contact", f"{area[r]:.1f} cm^2"), ("depth", f"{depth[r]:.2f} mm")]
        for r in rows
    ]


def metric_at_threshold(quality: Arrays, path: str) -> Floats:
    """Return a metric (N,) at the contact threshold of the index."""
    thresholds = np.asarray(quality["quality/thresholds_m"], float)
    return np.asarray(quality[path], float)[:, int(np.argmin(np.abs(thresholds - INDEX_THRESHOLD_M)))]


def contact_sheet(
    pictures: NDArray[np.uint8],
    captions: Sequence[Sequence[tuple[str, str]]] = (),
    *,
    title: str,
    subtitle: str = "",
    columns: int = 4,
) -> bytes:
    """Return a PNG of N pictures (N, H, W, 3) in a grid, ranked 1..N, with label and value pairs below."""
    rows = -(-max(1, len(pictures)) // columns)
    height, width = pictures.shape[1:3]
    page, draw, top = _create_page(columns, rows, width, height + _CAPTION, title, subtitle)
    for k, picture in enumerate(pictures):
        x = MARGIN + (k % columns) * (width + GAP)
        y = top + (k // columns) * (height + _CAPTION + GAP)
        page.paste(Image.fromarray(picture), (x, y))
        _caption(draw, (x, y + height), width, k + 1, captions[k] if k < len(captions) else ())
    return png_bytes(page)


def three_sides_sheet(
    pictures: NDArray[np.uint8], captions: Sequence[Sequence[tuple[str, str]]] = (), *, title: str, subtitle: str = ""
) -> bytes:
    """Return a PNG of N grasps from three sides (N, 3, H, W, 3): one strip per grasp, at most two per row."""
    seam = np.full((*pictures.shape[:1], pictures.shape[2], 4, 3), PAPER, np.uint8)
    strips = np.concatenate([part for side in np.moveaxis(pictures, 1, 0) for part in (seam, side)][1:], axis=2)
    return contact_sheet(strips, captions, title=title, subtitle=subtitle, columns=min(2, len(strips)))


def views_page(views: Arrays, *, title: str, subtitle: str = "") -> bytes:
    """Return a PNG of each placement's pictures, depth, segmentation, boxes, and the hand, if any."""
    eye = np.asarray(views["camera/eye"])
    stereo, first = bool((eye == 2).any()), np.flatnonzero(eye != 2)
    columns: dict[str, Callable[[int], Image.Image]] = {
        "left" if stereo else "colour": lambda view: _colour_image(views, "image/rgb", view),
        "right": lambda view: _colour_image(views, "image/rgb", view + 1),
        "depth": lambda view: _draw_depth(views, view),
        "segmentation": lambda view: _draw_segmentation(views, view),
        "boxes": lambda view: _draw_boxes(views, view),
        "hand": lambda view: _colour_image(views, "image/rgb_hand", view),
    }
    heads = [head for head in columns if (stereo or head != "right") and (head != "hand" or "image/rgb_hand" in views)]
    rows = [[columns[head](view) for head in heads] for view in first.tolist()]
    return label_page(rows, heads, (), title=title, subtitle=subtitle)


def label_page(
    rows: Sequence[Sequence[Image.Image]],
    heads: Sequence[str],
    names: Sequence[Sequence[str]],
    *,
    title: str,
    subtitle: str = "",
) -> bytes:
    """Return a PNG of pictures in rows under `heads`; `names`, if any, are below a row's first pictures."""
    width, height = rows[0][0].size
    line = height + (_NAME if names else 0)
    page, draw, top = _create_page(len(heads), len(rows), width, line, title, subtitle, head=_HEAD + 24)
    for column, head in enumerate(heads):
        draw_text(draw, (MARGIN + column * (width + GAP), top - 10), head, 15, QUIET)
    for row, (cells, below) in enumerate(zip(rows, names or [()] * len(rows), strict=True)):
        y = top + row * (line + GAP)
        for column, cell in enumerate(cells):
            page.paste(cell, (MARGIN + column * (width + GAP), y))
        for column, name in enumerate(below):
            draw_text(draw, (MARGIN + column * (width + GAP), y + line - 4), name, 14, INK)
    return png_bytes(page)


def _create_page(
    columns: int, rows: int, width: int, height: int, title: str, subtitle: str, head: int = _HEAD
) -> tuple[Image.Image, ImageDraw.ImageDraw, int]:
    """Return an empty page with its title, and the y at which the cells begin."""
    size = (2 * MARGIN + columns * (width + GAP) - GAP, MARGIN + head + rows * (height + GAP) - GAP + MARGIN)
    page = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(page)
    draw_text(draw, (MARGIN, MARGIN + 20), title, 26, INK)
    draw_text(draw, (MARGIN, MARGIN + 46), subtitle, 15, QUIET)
    return page, draw, MARGIN + head


def _caption(
    draw: ImageDraw.ImageDraw, at: tuple[int, int], width: int, rank: int, pairs: Sequence[tuple[str, str]]
) -> None:
    x, y = at
    draw.line([(x, y + 1), (x + width - 1, y + 1)], fill=RULE)
    draw_text(draw, (x, y + 26), str(rank), 17, ACCENT)
    # Space for ranks of up to three digits, then equal columns.
    left, step = x + 34, (width - 34) / max(1, len(pairs))
    for k, (label, value) in enumerate(pairs):
        draw_text(draw, (left + k * step, y + 18), label, 11, QUIET)
        draw_text(draw, (left + k * step, y + 35), value, 14, INK)


def _colour_image(views: Arrays, path: str, view: int) -> Image.Image:
    return Image.fromarray(np.asarray(views[path][view], np.uint8))


def _draw_depth(views: Arrays, view: int) -> Image.Image:
    depth = np.asarray(views["image/depth"][view], np.float32)
    solid = np.asarray(views["image/segmentation"][view]) == OBJECT
    finite = depth[np.isfinite(depth)]
    if finite.size == 0:
        return Image.fromarray(depth_colours(depth, 0.0, 1.0))
    # The distant table would dominate the range, but the object's surroundings matter.
    near, far = float(finite.min()), float(np.percentile(finite, 90))
    if solid.any():
        far = max(float(depth[solid].max()), min(far, float(depth[solid].max()) * 1.4))
    image = Image.fromarray(depth_colours(depth, near, far))
    _scale_bar(image, near, far)
    return image


def _scale_bar(image: Image.Image, near: float, far: float) -> None:
    ramp, before, after, thick = 64, 34, 46, 6
    if image.width < 2 * (before + ramp + after):
        return
    x, y = image.width - ramp - after, image.height - 13
    draw = ImageDraw.Draw(image)
    draw.rectangle([x - before, y - 7, image.width, image.height], fill=PAPER)
    colours = depth_colours(np.linspace(near, far, ramp, dtype=np.float32)[None].repeat(thick, 0), near, far)
    image.paste(Image.fromarray(colours), (x, y))
    draw_text(draw, (x - before + 6, y + thick + 1), f"{near:.2f}", 11, INK)
    draw_text(draw, (x + ramp + 6, y + thick + 1), f"{far:.2f} m", 11, INK)


def _draw_segmentation(views: Arrays, view: int) -> Image.Image:
    """Draw the labels; neighbours cycle through the colours after the object's."""
    labels = np.asarray(views["image/segmentation"][view], np.intp)
    beside = OBJECT + 1 + (labels - OBJECT - 1) % (len(_SEGMENT) - OBJECT - 1)
    return Image.fromarray(_SEGMENT[np.where(labels > OBJECT, beside, labels)])


def _draw_boxes(views: Arrays, view: int) -> Image.Image:
    rgb = np.asarray(views["image/rgb"][view], float)
    # Dimmed, so that the lines are visible on any material.
    table = np.asarray(views["image/segmentation"][view])[..., None] <= TABLE
    image = Image.fromarray(np.where(table, 0.55 * rgb, 0.9 * rgb).astype(np.uint8))
    scale = 3
    overlay = Image.new("RGBA", (image.width * scale, image.height * scale), (0, 0, 0, 0))
    draw = ImageDraw.Draw(overlay)
    corners = np.asarray(views["box/bounding_box_3d"][view], float) @ np.asarray(views["camera/intrinsics"][view]).T
    pixels = scale * corners[:, :2] / corners[:, 2:]
    for a, b in _EDGES:
        draw.line([tuple(pixels[a]), tuple(pixels[b])], fill=(*_BOX_3D, 255), width=4)
    for name, colour in (("loose", _LOOSE), ("tight", _TIGHT)):
        box = scale * np.asarray(views[f"box/bounding_box_2d_{name}"][view], float)
        if np.isfinite(box).all():
            draw.rectangle(tuple(box), outline=(*colour, 255), width=6 if name == "loose" else 3)
    small = overlay.resize(image.size, Image.Resampling.LANCZOS)
    image.paste(small, (0, 0), small)
    return image


PAPER: Final = (250, 250, 249)
INK: Final = (28, 32, 36)
QUIET: Final = (122, 128, 134)
RULE: Final = (222, 224, 226)
ACCENT: Final = (31, 132, 126)

#: Anchors of the depth colours, near to far: even steps of lightness from light to dark, hue from sand to indigo.
_DEPTH_HEX: Final = "fcf3cf face82 f39e5d dc675c ad3f6b 712b6d 362054 101028"
_DEPTH: Final = np.frombuffer(bytes.fromhex(_DEPTH_HEX), np.uint8).reshape(-1, 3)


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's own scalable font."""
    return ImageFont.load_default(size)


def draw_text(
    draw: ImageDraw.ImageDraw, at: tuple[float, float], words: str, size: int, fill: tuple[int, int, int]
) -> float:
    """Write words with the baseline at `at`; `^2` is set as an exponent. Return the x of their end."""
    x, y = at
    for k, part in enumerate(words.split("^")):
        if k and part:
            exponent, part = part[0], part[1:]
            small = font(round(0.62 * size))
            draw.text((x + 1, y - 0.38 * size), exponent, font=small, fill=fill, anchor="ls")
            x += 1 + small.getlength(exponent)
        draw.text((x, y), part, font=font(size), fill=fill, anchor="ls")
        x += font(size).getlength(part)
    return x


def depth_colours(depth: NDArray[np.float32], near: float, far: float) -> NDArray[np.uint8]:
    """Return colours (..., 3) of depths: light is near, dark is far, grey is no surface."""
    t = np.clip((np.where(np.isfinite(depth), depth, near) - near) / max(far - near, 1e-9), 0, 1) * (len(_DEPTH) - 1)
    low = np.minimum(t.astype(int), len(_DEPTH) - 2)
    anchors = _DEPTH.astype(float)
    mixed = anchors[low] + (t - low)[..., None] * (anchors[low + 1] - anchors[low])
    return np.where(np.isfinite(depth)[..., None], mixed, 214.0).round().astype(np.uint8)


def png_bytes(image: Image.Image) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def reduce_to_palette(page: bytes) -> bytes:
    """Return the PNG in 256 colours, for documentation: a third of the bytes."""
    return png_bytes(Image.open(io.BytesIO(page)).convert("RGB").quantize(256, method=Image.Quantize.MEDIANCUT))
