"""Published sets of objects: wheels, their checks on disk, shape classes and the split."""

import hashlib
import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from manifold3d import CrossSection, Manifold
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.object_options import ObjectOptions
from graspd.service.store import published_sets
from graspd.service.store.published_sets import SETS, PublishedSet, fetch_wheel, read_members
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import build_model, repaired_mesh
from graspd.worker.objects.shapes import shape_facts
from graspd.worker.objects.topology import from_manifold
from tests.worker.objects.shapes import Mesh, box, cylinder, stl

BODY = '<robot name="b"><link name="l"><inertial><mass value="0.1"/></inertial><visual><geometry>'
BODY += '<mesh filename="{}" scale="0.01 0.01 0.01"/></geometry></visual></link></robot>'
CUBE = "v 0 0 0\nv 6 0 0\nv 0 6 0\nv 6 6 0\nv 0 0 6\nv 6 0 6\nv 0 6 6\nv 6 6 6\n"
CUBE += "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n"


def wheel_of(members: dict[str, str]) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, text in members.items():
            archive.writestr(name, text)
    return packed.getvalue()


@pytest.fixture
def published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PublishedSet:
    """A set of four objects in a wheel that is in the cache already: pip would fail."""
    members = {f"toys/{name}/{name}.obj": CUBE for name in ("a", "b", "huge")} | {"toys/bad/bad.obj": "v 0 0 0\n"}
    members |= {f"toys/{name}/{name}.urdf": BODY.format(f"{name}.obj") for name in ("a", "b", "bad", "huge")}
    members["toys/huge/huge.urdf"] = members["toys/huge/huge.urdf"].replace("0.01", "0.025")
    wheel = wheel_of(members | {"toys/loose.obj": CUBE, "toys/__init__.py": "raise SystemExit"})
    found = PublishedSet("toys", "1.0", hashlib.sha256(wheel).hexdigest(), r"toys/.*\.(urdf|obj)", "MIT", "u", 400.0)
    monkeypatch.setitem(SETS, "toys", found)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", "")
    (folder := tmp_path / "cache" / "graspd" / "packages").mkdir(parents=True)
    (folder / "toys-1.0-py3-none-any.whl").write_bytes(wheel)
    return found


def test_a_set_is_checked_once_and_states_licence_and_mass(published: PublishedSet, tmp_path: Path) -> None:
    fetch = ["objects", "fetch", "toys", "--to", str(tmp_path / "to"), "--json"]
    told = [json.loads(CliRunner().invoke(build_app(), fetch).stdout.splitlines()[-1]) for _ in range(2)]
    # Mesh files that no description names are no objects. Equal times: the second call checks nothing.
    assert told[0] == told[1] and told[0]["accepted"] == 3
    assert {one["name"]: one["verdict"] for one in told[0]["objects"]}["toys-bad"] == "refuse"
    assert list(told[0]["refused"].values()) == [1] and "no faces" in next(iter(told[0]["refused"]))
    small, huge = (json.loads((tmp_path / "to" / name / "asset.json").read_bytes()) for name in ("toys-a", "toys-huge"))
    assert small == {"licence": "MIT", "source": "u", "file": "a.urdf", "density": 400.0}
    # 15 cm at 400 kg/m^3 weigh 1.35 kg.
    assert huge["mass"] == 1.0
    text = CliRunner().invoke(build_app(), [*fetch[:-1], "--count", "2"]).stdout
    assert "of 2 objects accepted" in text
    assert "there are: pybullet-random" in CliRunner().invoke(build_app(), ["objects", "fetch", "toy"]).stderr


def test_a_wheel_of_another_checksum_is_fetched_again(published: PublishedSet, tmp_path: Path) -> None:
    (wheel := next((tmp_path / "cache").rglob("*.whl"))).write_bytes(b"cut off")
    with pytest.raises(InputError, match=r"^toys 1.0 cannot be fetched: [^\n]+$"):
        fetch_wheel("toys", "1.0", published.sha256)
    assert not wheel.exists()


def test_members_stay_inside_and_within_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wheel = tmp_path / "w.whl"
    wheel.write_bytes(wheel_of({"a/../../x.obj": "v"}))
    with pytest.raises(InputError, match="leaves its folder"):
        read_members(wheel, r".*\.obj")
    wheel.write_bytes(wheel_of({"a.obj": "v 1 2 3", "b.txt": "no"}))
    assert read_members(wheel, r".*\.obj") == {"a.obj": b"v 1 2 3"}
    monkeypatch.setattr(published_sets, "_MAX_BYTES", 6)
    with pytest.raises(LimitError, match="more than 6 bytes"):
        read_members(wheel, r".*\.obj")
    wheel.write_bytes(wheel.read_bytes()[:40])
    with pytest.raises(InputError, match="damaged"):
        read_members(wheel, ".*")


def bowl() -> Mesh:
    upper = Manifold.cube((1, 1, 1)).translate((-0.5, -0.5, 0))
    return from_manifold(Manifold.sphere(0.05, 48) - Manifold.sphere(0.046, 48) - upper)


def wedge() -> Mesh:
    # Two faces that meet at 2 atan(0.3) = 33 degrees.
    return from_manifold(Manifold.extrude(CrossSection([[(0.0, -0.021), (0.07, 0.0), (0.0, 0.021)]]), 0.07))


def model_of(mesh: Mesh) -> ObjectModel:
    return build_model(repaired_mesh("m.stl", stl(mesh)["m.stl"], ObjectOptions()), 0.0)


@pytest.mark.parametrize(
    ("mesh", "kind"),
    [
        (box(0.1, 0.1, 0.01), "thin"),
        (box(0.04, 0.04, 0.04), "small"),
        (box(0.1, 0.1, 0.1), "wide"),
        (bowl(), "hollow"),
        (wedge(), "sharp"),
        (box(0.1, 0.09, 0.03), "flat"),
        (cylinder(0.02, 0.16), "long"),
        (box(0.07, 0.06, 0.06), "compact"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_classes_and_families_do_not_depend_on_the_pose(mesh: Mesh, kind: str) -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    found = [shape_facts(model_of((scale * mesh[0] @ turn.T + 1.0, mesh[1]))) for scale in (1.0, 1.3)]
    straight = shape_facts(model_of(mesh))
    assert straight["class"] == found[0]["class"] == kind
    assert straight["family"] == found[0]["family"] == found[1]["family"]
    assert straight["split"] == found[1]["split"]
    np.testing.assert_allclose(1.3 * np.array(found[0]["sides_m"]), found[1]["sides_m"], atol=2e-4)
    assert straight["sides_m"] == sorted(straight["sides_m"])
