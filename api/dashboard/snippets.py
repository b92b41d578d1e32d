"""Code to copy: how to load a job's files."""

from __future__ import annotations

from api.models import GraspDetail, JobDetail, Shard


def loader(job: JobDetail, base_url: str) -> str:
    """Python that downloads the job's first shard of grasps and reads it with h5py."""
    shard = next((shard for shard in job.shards if shard.kind == "base"), None)
    if shard is None:
        return ""
    return f"""import io, urllib.request
import h5py

url = "{base_url.rstrip("/")}{shard.file}"
with h5py.File(io.BytesIO(urllib.request.urlopen(url).read())) as shard:
    poses = shard["grasp/hand_pose"][:]          # (N, 7) x y z [m], quaternion w x y z
    joints = shard["grasp/joint_positions"][:]   # (N, J) rad or m
    names = shard["grasp/joint_positions"].attrs["joint_names"]
    valid = shard["quality/valid"][:].astype(bool)
    epsilon = shard["quality/epsilon"][:]        # (N, T) at the thresholds in quality/thresholds_m
print(valid.sum(), "of", len(valid), "grasps are valid")"""


def curl(job: JobDetail, base_url: str) -> str:
    """Shell lines that download every shard of the job shown on its page."""
    base = base_url.rstrip("/")
    lines = [f"curl -fL -o {shard.kind}-{shard.batch:04}.h5 {base}{shard.file}" for shard in job.shards]
    return "\n".join(lines)


def grasp_loader(grasp: GraspDetail, shard: Shard, base_url: str) -> str:
    """Python that reads one grasp out of its shard."""
    return f"""import io, urllib.request
import h5py

url = "{base_url.rstrip("/")}{shard.file}"
with h5py.File(io.BytesIO(urllib.request.urlopen(url).read())) as shard:
    pose = shard["grasp/hand_pose"][{grasp.row}]           # x y z [m], quaternion w x y z
    joints = shard["grasp/joint_positions"][{grasp.row}]   # rad or m"""
