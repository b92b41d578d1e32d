"""A policy cloned from episodes, beside replay of the nearest episode."""
