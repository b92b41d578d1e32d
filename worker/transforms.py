"""Rigid transforms, see `service.transforms`."""

from service.transforms import *  # noqa: F403
