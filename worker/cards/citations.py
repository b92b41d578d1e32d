"""What to cite for grasps of a method, as BibTeX."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

_ENTRIES: Final = {
    "fast_graspd": """@inproceedings{turpin2023fastgraspd,
  title     = {Fast-Grasp'D: Dexterous Multi-finger Grasp Generation Through Differentiable Simulation},
  author    = {Turpin, Dylan and Zhong, Tao and Zhang, Shutong and Zhu, Guanglei and Liu, Jingzhou and Singh, Ritvik and
               Heiden, Eric and Macklin, Miles and Tsogkas, Stavros and Dickinson, Sven and Garg, Animesh},
  booktitle = {IEEE International Conference on Robotics and Automation (ICRA)},
  year      = {2023}
}""",
    "graspd2022": """@inproceedings{turpin2022graspd,
  title     = {Grasp'D: Differentiable Contact-rich Grasp Synthesis for Multi-fingered Hands},
  author    = {Turpin, Dylan and Wang, Liquan and Heiden, Eric and Chen, Yun-Chun and Macklin, Miles and
               Tsogkas, Stavros and Dickinson, Sven and Garg, Animesh},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2022}
}""",
    "graspit": """@article{ciocarlie2009hand,
  title   = {Hand Posture Subspaces for Dexterous Robotic Grasping},
  author  = {Ciocarlie, Matei T. and Allen, Peter K.},
  journal = {The International Journal of Robotics Research},
  volume  = {28},
  number  = {7},
  year    = {2009}
}""",
    "dfc": """@inproceedings{wang2023dexgraspnet,
  title     = {DexGraspNet: A Large-Scale Robotic Dexterous Grasp Dataset for General Objects Based on Simulation},
  author    = {Wang, Ruicheng and Zhang, Jialiang and Chen, Jiayi and Xu, Yinzhen and Li, Puhao and Liu, Tengyu and
               Wang, He},
  booktitle = {IEEE International Conference on Robotics and Automation (ICRA)},
  year      = {2023}
}""",
    "autograsp": """@article{miller2004graspit,
  title   = {GraspIt! A Versatile Simulator for Robotic Grasping},
  author  = {Miller, Andrew T. and Allen, Peter K.},
  journal = {IEEE Robotics \\& Automation Magazine},
  volume  = {11},
  number  = {4},
  year    = {2004}
}""",
}


def citations(methods: Iterable[str], name: str, version: str, year: str, snapshot: str) -> str:
    """BibTeX of the methods' papers and of the dataset itself; `snapshot` may be empty."""
    note = f",\n  note   = {{snapshot {snapshot}}}" if snapshot else ""
    key = "".join(letter for letter in name if letter.isalnum()) or "dataset"
    own = f"""@misc{{{key}{year},
  title  = {{{name}: grasps made by graspd {version}}},
  year   = {{{year}}}{note}
}}"""
    return "\n\n".join([*(_ENTRIES[method] for method in methods if method in _ENTRIES), own])
