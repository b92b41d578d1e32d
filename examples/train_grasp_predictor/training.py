"""Training: the same number of steps for every dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import torch
from torch.nn.functional import affine_grid, grid_sample

from examples.train_grasp_predictor.network import Predictor, loss
from examples.train_grasp_predictor.samples import FAR, Example

BATCH: Final = 32
#: Grasps of a picture shown at a time.
SHOWN: Final = 8


def train(examples: Sequence[Example], *, steps: int, seed: int, rate: float = 1e-3) -> tuple[Predictor, float]:
    """A network trained on pictures, each with some of its grasps drawn anew each time.

    Returns:
        the network, and the mean loss over the last tenth of the steps.
    """
    torch.manual_seed(seed)
    network = Predictor(joints=examples[0].grasps.shape[1] - 9)
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=rate, total_steps=steps)
    late: list[float] = []
    for step in range(steps):
        chosen = torch.randint(len(examples), (BATCH,)).tolist()
        images = torch.stack([_jittered(examples[i].image) for i in chosen])
        shown = torch.stack([_drawn(examples[i].grasps) for i in chosen])
        images, shown = turned(images, shown, 2 * torch.pi * torch.rand(BATCH))
        proposed, logits = network(images)
        value = loss(proposed, logits, shown)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        schedule.step()
        if step >= 0.9 * steps:
            late.append(float(value.detach()))
    return network.eval(), sum(late) / max(1, len(late))


def turned(images: torch.Tensor, shown: torch.Tensor, angles: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Pictures (B, 5, H, H) and their grasps (B, G, 9 + J) as a camera turned about its axis sees them.

    Pixel axes are the camera's x and y, so one rotation by `angles` (B,) [rad] turns both. The object stands near the
    axis: what perspective changes is left out.
    """
    c, s = angles.cos(), angles.sin()
    zero = torch.zeros_like(c)
    inverse = torch.stack([torch.stack([c, s, zero], -1), torch.stack([-s, c, zero], -1)], 1)
    grid = affine_grid(inverse, list(images.shape), align_corners=False)
    empty = torch.zeros(images.shape[1])
    empty[3] = FAR
    shifted = grid_sample(images - empty[:, None, None], grid, mode="nearest", align_corners=False)
    rotation = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], 1)
    out = shown.clone()
    for first in (0, 3, 6):
        out[..., first : first + 2] = shown[..., first : first + 2] @ rotation.transpose(1, 2)
    return shifted + empty[:, None, None], out


def _drawn(grasps: torch.Tensor) -> torch.Tensor:
    return grasps[torch.randint(len(grasps), (SHOWN,))]


def _jittered(image: torch.Tensor) -> torch.Tensor:
    """Other light and a little noise: the network should not learn the colours of eight objects."""
    out = image.clone()
    out[:3] = (out[:3] * (0.6 + 0.8 * torch.rand(3, 1, 1)) + 0.05 * torch.randn_like(out[:3])).clamp(0, 1)
    out[3] += 0.02 * torch.randn_like(out[3])
    return out
