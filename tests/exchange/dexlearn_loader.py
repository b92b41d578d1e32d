"""DexLearn's loader, rebuilt: what it does was read in its source and is written anew here, without its draws of chance
and without torch.

Mingrui-Yu/DexLearn, dexlearn/dataset/base_dex.py at 2ae1aea3ab5b7360c6e39acd39d04d762bfc8678 (the data set), and its
twin in hugs-dex/HUGS-DexLearn at 95a3c2aa2808ab2e6db0f03d59ceb15cc3c7bebf (`load_scene_cfg` in dexlearn/utils/util.py).
"""

import json
from dataclasses import dataclass
from glob import glob
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation


@dataclass
class Sample:
    """What a network gets of one file, for each of its K grasps and not for one that is drawn."""

    file: Path
    grasp_type_id: int
    hand_trans: np.ndarray
    """(K, 3, 3): pregrasp, grasp, squeeze"""
    hand_rot: np.ndarray
    """(K, 3, 3, 3)"""
    hand_joint: np.ndarray
    """(K, 3, J)"""
    clouds: list[np.ndarray]
    """(P, 3) each, at the scale of the first grasp"""
    scene: dict


class Data:
    """The data set of a configuration, in a checkout at `root`, from where it is run."""

    def __init__(self, root: Path, name: str) -> None:
        said = yaml.safe_load((root / "dexlearn" / "config" / "data" / f"{name}.yaml").read_text())
        self.root, self.config = root, said
        self.grasps = root / said["grasp_path"].replace("${data_folder}", "assets")
        self.objects = root / said["object_path"].replace("${data_folder}", "assets")
        self.types = said["grasp_type_lst"]

    def split(self, name: str) -> list[str]:
        return list(json.loads((self.objects / self.config["split_path"] / f"{name}.json").read_text()))

    def samples(self, split: str) -> list[Sample]:
        """Of `train` or `test`: what may be drawn. A type without any object in the split would break the draw."""
        found = []
        for kind in self.types:
            files = [f for name in self.split(split) for f in _glob(f"{self.grasps}/{kind}/{name}/**/**.npy")]
            assert files, f"{kind} has no object in {split}"
            found += [self._sample(Path(file), kind) for file in sorted(files)]
        return found

    def test_scenes(self) -> list[dict]:
        """What is sampled for: each scene of a held-out object, with its clouds as `clouds`."""
        pattern = self.config["test_scene_cfg"]
        files = [f for name in self.split("test") for f in _glob(f"{self.objects}/scene_cfg/{name}/{pattern}")]
        scenes = [self._scene(Path(file)) for file in files]
        return [scene | {"clouds": self._clouds(scene)} for scene in scenes]

    def _sample(self, file: Path, kind: str) -> Sample:
        grasp = np.load(file, allow_pickle=True).item()
        pose = np.stack([grasp["pregrasp_qpos"], grasp["grasp_qpos"], grasp["squeeze_qpos"]], axis=-2)
        assert pose.ndim == 3, "one grasp a file is not implemented there"
        scene = self._scene(self.root / grasp["scene_path"])
        clouds = self._clouds(scene)
        if "scene_scale" in grasp:
            clouds = [cloud * grasp["scene_scale"][0] for cloud in clouds]
        number = int(kind.split("_")[0]) if self.config["grasp_type_cond"] else 0
        return Sample(file, number, pose[..., :3], _matrices(pose[..., 3:7]), pose[..., 7:], clouds, scene)

    def _scene(self, file: Path) -> dict:
        scene = np.load(file, allow_pickle=True).item()
        for thing in scene["scene"].values():
            for key in [key for key, value in thing.items() if key.endswith("_path") and isinstance(value, str)]:
                thing[key] = str(file.parent / thing[key])
        return scene

    def _clouds(self, scene: dict) -> list[np.ndarray]:
        files = sorted(_glob(f"{self.objects}/{self.config['pc_path']}/{scene['scene_id']}/partial_pc**.npy"))
        assert files, f"{scene['scene_id']} has no cloud to draw"
        return [np.load(file, allow_pickle=True) for file in files]


def _glob(pattern: str) -> list[str]:
    return glob(pattern, recursive=True)  # noqa: PTH207 (its pattern `**.npy` is none for pathlib)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    flat = Rotation.from_quat(quaternions.reshape(-1, 4), scalar_first=True).as_matrix()
    return np.asarray(flat.reshape(*quaternions.shape[:-1], 3, 3))
