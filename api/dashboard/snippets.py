"""Code to copy: how to load a job's files."""

from __future__ import annotations

from api.models import GraspDetail, JobDetail


def loader(job: JobDetail, base_url: str) -> str:
    """Python that fetches the job's grasps; empty while there are none."""
    if not any(shard.kind == "base" for shard in job.shards):
        return ""
    return f"""import graspd  # pip install 'graspd[api]'

with graspd.Client("{base_url.rstrip("/")}") as client:  # key="..." where the service asks for one
    grasps = client.job("{job.id}").grasps()
best = grasps.valid().top("epsilon", 10)
best.hand_pose        # (N, 7) x y z [m], quaternion w x y z
best.joint_positions  # (N, J) rad or m, in the order of best.joint_names
print(grasps)"""


def curl(job: JobDetail, base_url: str) -> str:
    """Shell lines that download every shard of the job shown on its page."""
    base = base_url.rstrip("/")
    lines = [f"curl -fL -o {shard.kind}-{shard.batch:04}.h5 {base}{shard.file}" for shard in job.shards]
    return "\n".join(lines)


def grasp_loader(grasp: GraspDetail, base_url: str) -> str:
    """Python that fetches one grasp of a shard."""
    return f"""import graspd  # pip install 'graspd[api]'

with graspd.Client("{base_url.rstrip("/")}") as client:  # key="..." where the service asks for one
    grasp = client.shard("{grasp.shard_id}")[{grasp.row}]
grasp.hand_pose  # (7,) x y z [m], quaternion w x y z
grasp.joints     # position of each joint by its name, rad or m"""
