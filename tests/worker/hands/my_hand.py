"""Files that the commands of docs/how-to/hands.md name, as a reader would have them."""

import zipfile
from pathlib import Path
from typing import Final

from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files
from tests.worker.hands.mjcfs import FOUR_BAR
from tests.worker.hands.test_descriptions import package
from tests.worker.hands.test_tree import humanoid
from tests.worker.hands.urdfs import gripper_urdf, joint, link, robot

#: Names of the built-in hand that stands for the reader's own, and of that.
_RENAMED: Final = {"thumb_rotation": "joint_12.0", "index_proximal": "joint_1.0", '"palm"': '"base_link"'}
_WRIST: Final = 'lower="-0.5" upper="0.5" effort="1" velocity="2"'


def write_my_hand(folder: Path) -> Path:
    """`my_hand/my_hand.urdf` and `my_hand.zip`: an Allegro hand of primitives with the names of the page."""
    text = builtin_files(AssetKind.HAND, "allegro")["allegro.urdf"].decode()
    for name, other in _RENAMED.items():
        assert name in text
        text = text.replace(name, other)
    (folder / "my_hand").mkdir()
    urdf = folder / "my_hand" / "my_hand.urdf"
    urdf.write_text(text)
    with zipfile.ZipFile(folder / "my_hand.zip", "w") as archive:
        archive.write(urdf, "my_hand/my_hand.urdf")
    return urdf


def write_all(folder: Path) -> None:
    """Everything that some `graspd hands check` of the page names."""
    write_my_hand(folder)
    urdf = package(folder / "my_description", "../meshes/finger.stl", manifest=True, urdf="urdf/my_hand.urdf")
    (urdf.parent / "my_hand.urdf.xacro").write_text(
        urdf.read_text()
        .replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)
        .replace(
            '<link name="palm">',
            '<link name="$(arg side)_frame"/><joint name="f" type="fixed"><parent link="'
            '$(arg side)_frame"/><child link="palm"/></joint><link name="palm">',
        )
    )
    (urdf.parent / "other.urdf").write_text("<robot/>")
    (folder / "my_model").mkdir()
    (folder / "my_model" / "hand.xml").write_text(FOUR_BAR)
    (folder / "my_robot.urdf").write_bytes(humanoid("left", "right"))
    (folder / "franka_hand").mkdir()
    (folder / "franka_hand" / "franka.urdf").write_bytes(gripper_urdf())
    (folder / "shadow").mkdir()
    (folder / "shadow" / "shadow_hand_right.urdf").write_bytes(_on_a_wrist())


def _on_a_wrist() -> bytes:
    places = {"FFJ4": "0.03 0 0.03", "LFJ4": "0.03 0.03 0.03"}
    return robot(
        *(link(name) for name in ("world", "wrist", "palm", "ff", "th", "lf")),
        joint("WRJ2", "world", "wrist", axis="1 0 0", limit=f"<limit {_WRIST}/>"),
        joint("WRJ1", "wrist", "palm", limit=f"<limit {_WRIST}/>"),
        *(joint(name, "palm", name[:2].lower(), origin=place, axis="0 -1 0") for name, place in places.items()),
        joint("THJ5", "palm", "th", origin="-0.03 0 0.03"),
    )
