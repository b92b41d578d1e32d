"""Films of episodes: a hand that flies to a mug, against the ray tracer and by what must be visible."""

import io

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import apply, invert, pose_to_matrix
from graspd.worker.episodes.episode import Episode, EpisodeOutcome, Robot
from graspd.worker.episodes.film import ARM, BACKDROP, HAND, OBJECT, SLAB, SUPPORT, EpisodeRenderer, FilmOptions
from graspd.worker.episodes.film import encode, film_options
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.rendering.hands import drawn_bodies, hand_parts
from graspd.worker.rendering.scenery import Appearance, Box, CameraShot, Lamp, Solid
from graspd.worker.rendering.tracer import Tracer

SIZE = (96, 72)
