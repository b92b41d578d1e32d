"""What is refused of a scene when it is submitted."""

from __future__ import annotations

from typing import Any

import pytest

from service.index.views import AssetView
from service.model import names
from service.model.errors import SceneError
from service.model.states import AssetKind
from service.pipeline import job_actions
from service.pipeline.backends import Services
from service.pipeline.job_actions import check_scene
from service.store.library import load_asset
from tests.fakes import request

UPRIGHT = [1.0, 0, 0, 0]
GROUND = {"kind": "half_space", "normal": [0, 0, 2], "offset": 0.2}
SLOPE = {"kind": "box", "size": [0.2, 0.2, 0.2], "pose": [0.5, 0, 0, 0.8, 0, 0.6, 0]}


def ball(centre: Any) -> AssetView:
    what = {"kind": AssetKind.OBJECT, "name": "ball", "digest": "b" * 32, "filename": "ball.stl", "files": []}
    found = {"verdict": "accept", "message": None, "repairs": [], "facts": {"centre_of_mass_m": centre}}
    return AssetView(**what, **found, size_bytes=1, created="", builtin=False)


@pytest.mark.parametrize(
    ("supports", "target", "said"),
    [
        # The plane lies at 0.2 / |normal| = 0.1 m, the centre at 0.03.
        ([GROUND], [0, 0, 0, *UPRIGHT], "support 0 of its scene: its centre lies 70 mm deep"),
        ([GROUND], [0, 0, 0.0995, *UPRIGHT], None),
        # The box's middle is 20 mm from the centre, whichever way the box is turned.
        ([GROUND, SLOPE], [0.52, 0, 0.3, *UPRIGHT], None),
        ([SLOPE], [0.5, 0, -0.03, *UPRIGHT], "support 0 of its scene: its centre lies 100 mm deep"),
        # Turned upside down about x the centre hangs below the frame.
        ([GROUND], [0, 0, 0.12, 0, 1, 0, 0], "support 0 of its scene: its centre lies 10 mm deep"),
    ],
)
def test_a_target_whose_centre_lies_in_a_support_is_refused(supports: Any, target: Any, said: str | None) -> None:
    wanted = request(scene={"supports": supports, "target": target})
    if said is None:
        check_scene(wanted, ball([0, 0, 0.03]))
        return
    with pytest.raises(SceneError, match=said):
        check_scene(wanted, ball([0, 0, 0.03]))


def test_where_the_centre_is_not_known_a_worker_tells() -> None:
    check_scene(request(scene={"supports": [GROUND], "target": [0, 0, -1, *UPRIGHT]}), ball(None))


def test_a_refused_scene_leaves_no_job_behind(services: Services) -> None:
    asset = services.index.assets.get(AssetKind.OBJECT, "ball")
    facts = {"verdict": "accept", "facts": {"centre_of_mass_m": [0.0, 0.0, 0.0]}}
    services.index.write.add_asset(load_asset(services.store, AssetKind.OBJECT, asset.digest), facts)
    with pytest.raises(SceneError, match="ball stands in support 0"):
        job_actions.submit(services, request(scene={"supports": [GROUND], "target": [0, 0, 0, *UPRIGHT]}))
    assert list(services.store.list(names.JOBS)) == []
