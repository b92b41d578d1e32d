"""The render bench: what it calls the bare ray tracer is one, and its shares are shares."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from graspd.commands.admin import app
from graspd.studies.rendering_bench import COMPRESSIONS, bench_render, tables
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.rendering.scene_setup import CameraPlan, Setting
from tests.worker.models import object_from_mesh

BLOCK = object_from_mesh(trimesh.creation.box((0.05, 0.06, 0.07)), "block")


def test_the_bare_tracer_traces_the_same_scene():
    poses = np.array([[[0, 0, 0.035, 1.0, 0, 0, 0]]])
    setting = Setting([BLOCK], poses, CameraPlan(2, 48, 36, None), seed=0, samples=4)
    whole = setting.shoot(ExecutionContext())
    bare = setting.stage("cpu").shoot(replace(setting.shot, shaded=False))
    np.testing.assert_array_equal(bare.shape, whole.shape)
    np.testing.assert_array_equal(bare.depth, whole.depth)
    assert not bare.rgb.any() and whole.rgb.any()


def test_the_shares_add_up_and_every_way_to_store_is_measured():
    result = bench_render(BLOCK, width=48, height=36, device="cpu", repeats=1)
    assert sum(result["share"].values()) == pytest.approx(1.0)
    assert all(0 <= share <= 1 for share in result["share"].values())
    assert 0 < result["images_per_second"] < result["rendered_per_second"]
    stored = result["compression"]
    assert set(stored) == set(COMPRESSIONS)
    assert stored["gzip 1 + shuffle"]["bytes"] < stored["none"]["bytes"]
    assert "48 x 36" in tables([result])


@pytest.mark.parametrize("size", ["320", "8x8", "320x5000", "axb"])
def test_a_size_that_is_none_is_refused_by_name(size):
    result = CliRunner().invoke(app, ["bench-render", "--device", "cpu", "--size", size])
    assert result.exit_code == 2
    assert size in result.output
