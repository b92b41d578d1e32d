"""Studies that make the figures and pictures of the docs: their commands and files.

Names in commands: `DATA` is a folder with hands/ and objects/ (real URDFs, YCB meshes), `SOURCES` a folder with the
packages of `benchmarks.gallery`. `BEFORE` is a checkout for comparison, `WORK` a folder for intermediate results. `OUT`
is the folder of the docs: docs/, or another one for quick runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

PLANS: Final = ("synthesize",)
IN_SCENES: Final = ("synthesize", "scene")
ALL: Final = ("synthesize", "scene", "render")
#: Requirements of studies besides DATA, SOURCES and BEFORE.
SERVICE, BROWSER, GPU, TORCH, PREFILTER = "a service", "a browser", "a GPU", "PyTorch", "mujoco-warp"
ENGINES: Final = "sapien and drake"
#: Suffixes of raw results. Raw results are not in git.
RAW: Final = frozenset({".json", ".csv", ".svg", ".sha256"})
#: Files with such a suffix that are in git, because they are written by hand.
NOT_RAW: Final = frozenset({"results/pilot/assets.json"})
#: Files that the study `predictor` leaves in WORK.
NETWORK = "trained networks"

_ALLEGRO = "DATA/hands/allegro/allegro_hand_right.urdf"
_BARRETT = "DATA/hands/barrett_bh280/bh280.urdf"
_SHADOW = "DATA/hands/shadow/shadow_hand_right.urdf"
_EIGHT = (
    "003_cracker_box 005_tomato_soup_can 006_mustard_bottle 011_banana 024_bowl 025_mug 035_power_drill 037_scissors"
)
_SEVEN = (
    "056_tennis_ball 061_foam_brick 077_rubiks_cube 005_tomato_soup_can 003_cracker_box 006_mustard_bottle "
    "035_power_drill"
)
_LITTLE = "--hands barrett --objects 077_rubiks_cube --grasps 4"
_MERGED = (
    "graspd stability --from WORK/integrators/stability.json --from WORK/shapes/stability.json "
    "--out OUT/results/stability"
)
_MERGED_HANDS = (
    "graspd stability --from WORK/hands/stability.json --from WORK/baselines/stability.json "
    "--out OUT/results/hands-stability"
)


_TRAIN = (
    "python -m examples.train_grasp_predictor --shards WORK/tables --free WORK/free --baseline WORK/baseline "
    "--meshes DATA/objects --held-out 006_mustard_bottle,025_mug,035_power_drill,061_foam_brick "
    "-o OUT/results/predictor.json"
)


#: Warp's example of a stage.
_BEAR: Final = "$(python -c 'import warp; print(warp.__path__[0])')/examples/assets/bear.usd"


def _mesh(name: str) -> str:
    return f"DATA/objects/{name}/clean.stl"


def _trajectory_pictures(hand: str, obj: str, scene: str) -> tuple[str, str]:
    picture = f"OUT/images/scenes/{Path(scene).stem}.png"
    return (
        f"graspd synth --hand {hand} --object {obj} --scene {scene} --scenes 2 -n 8 -o WORK/trajectory.h5",
        f"graspd pictures WORK/trajectory.h5 --trajectory -n 2 --size 240 --palette -o {picture}",
    )


@dataclass(frozen=True)
class Study:
    """A study; `files` are globs under the folder of the docs.
    A study without `quick` has no quick run. A study without `run` is a page written by hand. `stages` are the stages
    whose revisions affect its figures; studies of times have none, because times depend on all code."""

    name: str
    about: str
    files: tuple[str, ...]
    run: tuple[str, ...]
    quick: tuple[str, ...] = ()
    stages: tuple[str, ...] = PLANS
    seeds: tuple[int, ...] = ()
    needs: tuple[str, ...] = ()
    prints: str = ""
    """File under the folder of the docs for the output of the commands."""

    def wants(self) -> list[str]:
        """Return all requirements: places in the commands, then `needs`."""
        words = " ".join(self.run)
        return [name for name in ("DATA", "SOURCES", "BEFORE") if name in words] + list(self.needs)


STUDIES: Final = (
    Study(
        "bench",
        "grasps per second of the planner",
        ("results/bench.json", "results/bench.md"),
        (
            f"graspd bench --hand {_ALLEGRO} --object {_mesh('025_mug')} --fidelity draft --fidelity standard "
            "--fidelity fine --batch 1 --batch 8 --batch 32 --batch 128 --threads 1 --threads 2 --out OUT/results",
        ),
        ("graspd bench --fidelity draft --batch 4 --threads 2 --repeats 1 --out OUT/results",),
        stages=(),
    ),
    Study(
        "bench-points",
        "grasps per second by hand points and faces",
        ("results/bench-points/bench.json", "results/bench-points/bench.md"),
        ("python -m benchmarks.bench_points DATA --out OUT/results/bench-points",),
        ("python -m benchmarks.bench_points DATA --points 300 --repeats 1 --out OUT/results/bench-points",),
        stages=(),
    ),
    Study(
        "chart",
        "speed against accuracy: methods, fidelities",
        ("results/chart.*",),
        (
            f"graspd chart --hands {_ALLEGRO},{_BARRETT} --objects {_mesh('006_mustard_bottle')},{_mesh('025_mug')},"
            f"{_mesh('035_power_drill')},{_mesh('011_banana')} --batch 32 --baseline-batch 8 --repeats 2 "
            "--out OUT/results",
        ),
        ("graspd chart --quick --hands barrett --objects block --out OUT/results",),
    ),
    Study(
        "sweeps",
        "speed against accuracy: single settings",
        ("results/sweeps.*",),
        (f"python -m benchmarks.sweeps --hand {_ALLEGRO} --object {_mesh('006_mustard_bottle')} --out OUT/results",),
        ("python -m benchmarks.sweeps --quick --hand barrett --object block --out OUT/results",),
    ),
    Study(
        "scenes-chart",
        "grasps planned in scenes, compared with filtered free grasps",
        ("results/scenes-chart/*",),
        (
            f"python -m benchmarks.scenes_chart --hands {_ALLEGRO} {_BARRETT} --objects {_mesh('025_mug')} "
            f"{_mesh('006_mustard_bottle')} {_mesh('003_cracker_box')} --batch 24 --baseline-batch 24 --threads 1 "
            "--work WORK/scenes-chart --out OUT/results/scenes-chart",
        ),
        (
            "python -m benchmarks.scenes_chart --quick --hands barrett --objects block --work WORK/scenes-chart "
            "--out OUT/results/scenes-chart",
        ),
        IN_SCENES,
    ),
    Study(
        "stability",
        "failures of integrators, gradients, starts and rates",
        ("results/stability/*",),
        (
            "python -m benchmarks.integrators --out WORK/integrators",
            "graspd stability --only shapes --out WORK/shapes",
            _MERGED,
        ),
        (
            "python -m benchmarks.integrators --quick --only time_step gradient --out WORK/integrators",
            "graspd stability --quick --only shapes --out WORK/shapes",
            _MERGED,
        ),
    ),
    Study(
        "hands-stability",
        "failures with difficult hands, model errors and baselines",
        ("results/hands-stability/*",),
        (
            "graspd stability --only baselines --out WORK/baselines",
            "python -m benchmarks.integrators --only hands model_errors --out WORK/hands",
            _MERGED_HANDS,
        ),
        (
            "graspd stability --quick --only baselines --out WORK/baselines",
            "python -m benchmarks.integrators --quick --only hands model_errors --out WORK/hands",
            _MERGED_HANDS,
        ),
    ),
    Study(
        "scenes-stability",
        "failures of planning in scenes",
        ("results/scenes-stability/*",),
        (
            "python -m benchmarks.integrators --only scene_height scene_wall scene_neighbours scene_size "
            "--out OUT/results/scenes-stability",
        ),
        ("python -m benchmarks.integrators --quick --only scene_height --out OUT/results/scenes-stability",),
        IN_SCENES,
    ),
    Study(
        "quality",
        "every metric of candidates, under the unmodified DexGraspBench protocol",
        ("results/quality-*",),
        ("python -m benchmarks.results_tables DATA --work WORK/cells --out OUT/results",),
        (f"python -m benchmarks.results_tables DATA --work WORK/cells {_LITTLE} --out OUT/results",),
        seeds=(7001,),
    ),
    Study(
        "validation-levels",
        "cost and agreement of the validator's levels",
        ("results/validation-levels.*",),
        (
            f"python -m benchmarks.validation_levels DATA --work WORK/cells --objects {_EIGHT} "
            "--out OUT/results/validation-levels.json",
        ),
        (
            f"python -m benchmarks.validation_levels DATA --work WORK/cells {_LITTLE} "
            "--out OUT/results/validation-levels.json",
        ),
        seeds=(7001,),
        prints="results/validation-levels.md",
    ),
    Study(
        "prefilter",
        "agreement of the prefilter with level standard",
        ("results/prefilter.*",),
        ("python -m benchmarks.prefilter DATA --work WORK/cells --out OUT/results/prefilter",),
        (f"python -m benchmarks.prefilter DATA --work WORK/cells {_LITTLE} --out OUT/results/prefilter",),
        seeds=(7001,),
        needs=(PREFILTER,),
    ),
    Study(
        "engines",
        "verdicts of several engines on the same candidates",
        ("results/engines.md",),
        (
            "python -m benchmarks.engines DATA --grasps 18 --engines mujoco,physx,drake --section agreement "
            "--page OUT/results/engines.md",
            "python -m benchmarks.engines DATA --objects 035_power_drill 011_banana 025_mug --grasps 5 "
            "--engines mujoco,physx,drake --variants --section held-back starts causes --page OUT/results/engines.md",
        ),
        (
            "python -m benchmarks.engines DATA --hands barrett --objects 077_rubiks_cube --grasps 2 "
            "--engines mujoco,physx,drake --page OUT/results/engines.md",
        ),
        IN_SCENES,
        seeds=(1500,),
        needs=(ENGINES,),
    ),
    Study(
        "robust",
        "verdicts in models that differ from the nominal one",
        ("results/robust.*",),
        ("python -m benchmarks.robust DATA --work WORK/cells --out OUT/results",),
        (f"python -m benchmarks.robust DATA --work WORK/cells {_LITTLE} --draws 1 --out OUT/results",),
        seeds=(7001, 9102),
    ),
    Study(
        "foreign",
        "grasps planned with one model of a hand, validated in another",
        ("results/foreign.*",),
        (
            f"python -m benchmarks.foreign DATA --sources SOURCES --work WORK --objects {_SEVEN} "
            "--out OUT/results/foreign",
        ),
        (
            "python -m benchmarks.foreign DATA --sources SOURCES --work WORK --grasps 2 --objects 056_tennis_ball "
            "--out OUT/results/foreign",
        ),
        seeds=(7020,),
    ),
    Study(
        "success",
        "success by hand and object, quality by hand",
        ("results/success.md",),
        ("python -m benchmarks.success DATA 32",),
        ("python -m benchmarks.success DATA 1 Barrett",),
        seeds=(101,),
        prints="results/success.md",
    ),
    Study(
        "penetration",
        "penetration with and without the final projection",
        ("results/penetration.md",),
        ("python -m benchmarks.penetration DATA",),
        ("python -m benchmarks.penetration DATA --objects 056_tennis_ball --grasps 4",),
        seeds=(2,),
        prints="results/penetration.md",
    ),
    Study(
        "recipes",
        "effect of the planner's settings",
        ("results/recipes.md",),
        ("python -m benchmarks.recipes DATA",),
        ("python -m benchmarks.recipes DATA --objects 077_rubiks_cube --grasps 4",),
        seeds=(101,),
        prints="results/recipes.md",
    ),
    Study(
        "rollouts",
        "candidates selected by merit, and by rollouts",
        ("results/rollouts.*",),
        ("python -m benchmarks.rollouts DATA --work WORK --out OUT/results",),
        (f"python -m benchmarks.rollouts DATA --work WORK {_LITTLE} --out OUT/results",),
        seeds=(2027,),
    ),
    Study(
        "failures",
        "remaining failures, with pictures",
        ("results/failures.*", "results/failures/*"),
        (f"python -m benchmarks.failures DATA --work WORK/cells --objects {_EIGHT} --out OUT/results",),
        (f"python -m benchmarks.failures DATA --work WORK/cells {_LITTLE} --out OUT/results",),
        seeds=(7001,),
    ),
    Study(
        "diversity",
        "diversity of candidates",
        ("results/diversity.md",),
        (f"python -m benchmarks.diversity DATA --work WORK/cells --objects {_EIGHT}",),
        (f"python -m benchmarks.diversity DATA --work WORK/cells {_LITTLE}",),
        seeds=(7001,),
        prints="results/diversity.md",
    ),
    Study(
        "contact-threshold",
        "quality against the contact threshold",
        ("results/contact-threshold.*",),
        ("python -m benchmarks.contact_threshold DATA --work WORK/cells --out OUT/results",),
        (f"python -m benchmarks.contact_threshold DATA --work WORK/cells {_LITTLE} --out OUT/results",),
        seeds=(7001,),
    ),
    Study(
        "published-picks",
        "published picks, compared with graspd's verdicts",
        ("results/published-picks.*",),
        ("python -m benchmarks.published_picks DATA --work WORK/picks --out OUT/results/published-picks",),
        (
            "python -m benchmarks.published_picks DATA --work WORK/picks --objects 011_banana "
            "--out OUT/results/published-picks",
        ),
        stages=(),
    ),
    Study(
        "scenes-grasps",
        "grasps planned in scenes, by hand and object",
        ("results/scenes-grasps.*",),
        (
            "python -m benchmarks.scene_grasps DATA --work WORK --grasps 16 --per-face 2 --filtered 96 "
            "--page OUT/results/scenes-grasps.md --json OUT/results/scenes-grasps.json",
        ),
        (
            f"python -m benchmarks.scene_grasps DATA --work WORK {_LITTLE} "
            "--page OUT/results/scenes-grasps.md --json OUT/results/scenes-grasps.json",
        ),
        IN_SCENES,
        seeds=(404,),
    ),
    Study(
        "clutter",
        "grasps of a target among neighbours, in limited time",
        ("results/clutter.*",),
        ("python -m benchmarks.clutter DATA --json OUT/results/clutter.json",),
        (
            "python -m benchmarks.clutter DATA --hand barrett --targets 077_rubiks_cube --scenes 1 --neighbours 1 "
            "--seconds 5 --json OUT/results/clutter.json",
        ),
        IN_SCENES,
        prints="results/clutter.md",
    ),
    Study(
        "chain",
        "what a valid grasp costs, stage by stage",
        ("results/chain.*",),
        ("python -m benchmarks.chain BEFORE . DATA --json OUT/results/chain.json",),
        ("python -m benchmarks.chain BEFORE . DATA --grasps 32 --pairs allegro:mug --json OUT/results/chain.json",),
        stages=(),
        prints="results/chain.md",
    ),
    Study(
        "cold-start",
        "how long the first grasp takes",
        ("results/cold-start.md",),
        ("python -m benchmarks.cold_start .",),
        ("python -m benchmarks.cold_start . --runs 1 --no-service",),
        stages=(),
        prints="results/cold-start.md",
    ),
    Study(
        "weight",
        "sizes of installs and times of imports",
        ("results/weight.*",),
        ("python -m benchmarks.weight --json OUT/results/weight.json",),
        ("python -m benchmarks.weight --json OUT/results/weight.json --runs 1 --no-wheel",),
        stages=(),
        prints="results/weight.md",
    ),
    Study(
        "fleet",
        "how many workers one controller serves",
        ("results/fleet.*",),
        ("python -m benchmarks.fleet --seconds 8 --tasks 4000 --json OUT/results/fleet.json",),
        ("python -m benchmarks.fleet --workers 8 --seconds 2 --tasks 100 --sqlite --json OUT/results/fleet.json",),
        stages=(),
        prints="results/fleet.md",
    ),
    Study(
        "week",
        "simulation of a week on a thousand preemptible nodes",
        ("results/week.*",),
        ("python -m benchmarks.week --json OUT/results/week.json",),
        ("python -m benchmarks.week --nodes 20 --days 1 --json OUT/results/week.json",),
        stages=(),
        seeds=(0,),
        prints="results/week.md",
    ),
    Study(
        "cost-model",
        "what a million grasps cost",
        ("results/cost-model.md",),
        ("python -m benchmarks.cost_model",),
        ("python -m benchmarks.cost_model",),
        stages=(),
        prints="results/cost-model.md",
    ),
    Study(
        "service",
        "cost of the service besides the engine",
        ("results/service-tables.md",),
        (
            "python -m benchmarks.large_index --data-dir WORK/large-index",
            "python -m benchmarks.service_load api --data-dir WORK/large-index",
            *(f"python -m benchmarks.service_load {what}" for what in ("queue", "workers", "indexer")),
        ),
        stages=(),
        prints="results/service-tables.md",
    ),
    Study("service-page", "cost of the service: figures and conditions", ("results/service.md",), (), stages=()),
    Study(
        "matrix",
        "four hands on fourteen objects, with a crash in the middle",
        ("results/matrix.md",),
        ("python -m benchmarks.matrix DATA --data-dir WORK/matrix --out OUT/results/matrix.md",),
    ),
    Study(
        "objects",
        "a published set of objects and five hands, with killed workers",
        ("results/objects*",),
        (
            "python -m benchmarks.object_run --work WORK/objects --out OUT/results/objects.md",
            "python -m benchmarks.object_run --work WORK/planners --objects 12 --grasps 4 --hands allegro --scenes "
            "free --compared 5 --no-failures --out OUT/results/objects-planners.md",
        ),
        ("python -m benchmarks.object_run --work WORK/objects --objects 4 --grasps 8 --out OUT/results/objects.md",),
        stages=ALL,
        seeds=(0,),
    ),
    Study(
        "predictor",
        "proposals of networks trained on grasps on tables",
        ("results/predictor.json", "results/predictor-barrett.png", "results/predictor-allegro.png"),
        (
            "graspd datasets create --spec examples/tables/tables.toml --objects DATA/objects --yes --wait",
            "graspd datasets export tables -o WORK/tables",
            "bash examples/train_grasp_predictor/data.sh DATA/objects WORK",
            "graspd datasets create tables-raw --hands barrett --objects DATA/objects --grasps 256 --want candidates "
            "--scene table --faces all --views 2 --yes --wait",
            "graspd datasets export tables-raw -o WORK/raw",
            f"{_TRAIN} --hand barrett --network WORK/barrett.npz --sheet OUT/results/predictor-barrett.png "
            "--raw WORK/raw --ablations",
            f"{_TRAIN} --hand allegro --network WORK/allegro.npz --sheet OUT/results/predictor-allegro.png",
        ),
        stages=ALL,
        seeds=(0, 1, 2),
        needs=(SERVICE, TORCH),
    ),
    Study(
        "predictor-page", "success of these networks: figures and conditions", ("results/predictor.md",), (), stages=ALL
    ),
    Study(
        "learned",
        "starts from a network, compared with the planner's own",
        ("results/learned.*",),
        (
            "python -m benchmarks.learned --network WORK/barrett.npz WORK/allegro.npz --data DATA --seeds 3 "
            "--out OUT/results",
        ),
        stages=IN_SCENES,
        seeds=(404,),
        needs=(NETWORK,),
    ),
    Study(
        "modelling",
        "effects that graspd does not model: cost and influence",
        ("results/modelling.json",),
        ("python -m benchmarks.modelling --data DATA --out OUT/results",),
        ("python -m benchmarks.modelling --only drops --grasps 2 --out OUT/results",),
        ALL,
        prints="results/modelling.md",
    ),
    Study(
        "scene-ways",
        "obstructed grasps in scenes, by phase of the trajectory",
        ("results/scene-ways.md",),
        ("python -m benchmarks.scene_trajectories",),
        ("python -m benchmarks.scene_trajectories --count 1",),
        IN_SCENES,
        prints="results/scene-ways.md",
    ),
    Study(
        "grippers",
        "success of grippers on objects that fit",
        ("results/grippers.*",),
        ("python -m benchmarks.grippers DATA --sources SOURCES --out OUT/results",),
        ("python -m benchmarks.grippers DATA --sources SOURCES --only robotiq-2f-85 --grasps 1 --out OUT/results",),
        seeds=(404,),
    ),
    Study(
        "episodes",
        "episodes of table grasps by a flying hand and two arms",
        ("results/episodes.md",),
        (
            "python -m benchmarks.episodes DATA --objects 011_banana 025_mug 035_power_drill 077_rubiks_cube "
            "--grasps 12 --page OUT/results/episodes.md",
        ),
        (
            "python -m benchmarks.episodes DATA --hands barrett --objects 025_mug --grasps 2 "
            "--page OUT/results/episodes.md",
        ),
        IN_SCENES,
        seeds=(1200,),
    ),
    Study(
        "masses",
        "table lifts of objects with published masses",
        ("results/masses.md",),
        ("python -m benchmarks.masses DATA --page OUT/results/masses.md",),
        ("python -m benchmarks.masses DATA --hands barrett --objects 025_mug --grasps 2 --page OUT/results/masses.md",),
        IN_SCENES,
        seeds=(1200,),
    ),
    Study(
        "flat",
        "table lifts of flat and thin objects",
        ("results/flat.md",),
        ("python -m benchmarks.flat DATA --page OUT/results/flat.md",),
        ("python -m benchmarks.flat DATA --hands barrett --things 60x60x10 --grasps 2 --page OUT/results/flat.md",),
        IN_SCENES,
        seeds=(1300,),
    ),
    Study(
        "corners",
        "lifts beside walls and among neighbours",
        ("results/corners.md",),
        ("python -m benchmarks.corners DATA --hands barrett --grasps 8 --page OUT/results/corners.md",),
        (
            "python -m benchmarks.corners DATA --hands barrett --places wall --gaps 10 --grasps 2 "
            "--page OUT/results/corners.md",
        ),
        IN_SCENES,
        seeds=(1400,),
    ),
    Study(
        "rolling",
        "rest poses in which objects roll or topple",
        ("results/rolling.md",),
        ("python -m benchmarks.rolling DATA --page OUT/results/rolling.md",),
        ("python -m benchmarks.rolling DATA --objects 025_mug --variants 2 --page OUT/results/rolling.md",),
        IN_SCENES,
        seeds=(5,),
    ),
    Study(
        "second-lift",
        "valid grasps in a second, independent lift test",
        ("results/second_lift.md",),
        ("python -m benchmarks.second_lift DATA --grasps 12 --page OUT/results/second_lift.md",),
        (
            "python -m benchmarks.second_lift DATA --hands barrett --objects 025_mug --grasps 2 "
            "--page OUT/results/second_lift.md",
        ),
        IN_SCENES,
        seeds=(1400,),
    ),
    Study(
        "payload",
        "payload of grasps: error and cost",
        ("results/payload.md", "results/payload-free.md"),
        (
            "python -m benchmarks.payload DATA --page OUT/results/payload.md",
            "python -m benchmarks.payload DATA --free --page OUT/results/payload-free.md",
        ),
        (
            "python -m benchmarks.payload DATA --hands barrett --objects 025_mug --grasps 2 "
            "--page OUT/results/payload.md",
            "python -m benchmarks.payload DATA --hands barrett --objects 025_mug --grasps 2 --free "
            "--page OUT/results/payload-free.md",
        ),
        IN_SCENES,
        seeds=(1500,),
    ),
    Study(
        "published-hands",
        "self-test and lifts of published hands",
        ("results/published_hands.*",),
        ("python -m benchmarks.published_hands SOURCES --data DATA --grasps 12 --out OUT/results",),
        ("python -m benchmarks.published_hands SOURCES --data DATA --only robotiq-2f-85 --grasps 2 --out OUT/results",),
        IN_SCENES,
        seeds=(404,),
    ),
    Study(
        "hands-gallery",
        "published hands, each tested on simple objects",
        ("results/hands-gallery.json", "results/hands-gallery.md", "images/hands-gallery/*"),
        ("python -m benchmarks.gallery --sources SOURCES --out OUT",),
        ("python -m benchmarks.gallery --sources SOURCES --only robotiq-2f-85 --grasps 3 --out OUT",),
    ),
    Study(
        "pilot",
        "card of the dataset pilot: 10,080 grasps",
        (
            "results/pilot/README.md",
            "results/pilot/card.json",
            "results/pilot/checksums.sha256",
            "results/pilot/*.png",
            "results/pilot/*.jpg",
        ),
        (
            "graspd datasets create pilot --spec examples/million/million.toml --objects "
            "DATA/objects -n 240 --yes --wait",
            "graspd datasets snapshot pilot",
            "graspd datasets card pilot -o OUT/results/pilot --licence CC-BY-4.0 --assets "
            "docs/results/pilot/assets.json",
        ),
        (
            "graspd datasets create pilot --hands barrett --objects block -n 4 --fidelity draft --yes --wait",
            "graspd datasets snapshot pilot",
            "graspd datasets card pilot -o OUT/results/pilot --licence CC-BY-4.0",
        ),
        ALL,
        seeds=(0,),
        needs=(SERVICE,),
    ),
    Study(
        "tables",
        "card of the dataset tables: 10,506 grasps",
        (
            "results/tables/README.md",
            "results/tables/card.json",
            "results/tables/checksums.sha256",
            "results/tables/*.png",
            "results/tables/*.jpg",
        ),
        (
            "graspd datasets create --spec examples/tables/tables.toml --objects DATA/objects --yes --wait",
            "graspd datasets snapshot tables",
            "graspd datasets card tables -o OUT/results/tables --licence CC-BY-4.0 "
            "--assets docs/results/pilot/assets.json",
        ),
        (
            "graspd datasets create --spec examples/tables/tables.toml --hands barrett --objects block -n 4 "
            "--fidelity draft --yes --wait",
            "graspd datasets snapshot tables",
            "graspd datasets card tables -o OUT/results/tables --licence CC-BY-4.0",
        ),
        ALL,
        seeds=(0,),
        needs=(SERVICE,),
    ),
    Study("pilot-assets", "licences and sources of the pilot's objects", ("results/pilot/assets.json",), (), stages=()),
    Study(
        "gpu",
        "speed and accuracy on a GPU",
        ("results/gpu.*",),
        (
            "python -m benchmarks.on_gpu DATA --batches 32 256 1024 4096 --grasps 32 --json OUT/results/gpu.json "
            "--page OUT/results/gpu.md",
        ),
        needs=(GPU,),
    ),
    Study(
        "usd",
        "grasps of a hand and an object from USD",
        ("images/usd.png",),
        (
            f"graspd synth --hand tests/worker/hands/barrett.usdc --object {_BEAR} --scale-to 0.1 -n 4 -o WORK/usd.h5",
            "graspd pictures WORK/usd.h5 --palette -o OUT/images/usd.png",
        ),
        seeds=(0,),
    ),
    Study(
        "demo",
        "pictures in the README",
        ("images/demo-*",),
        (
            "graspd demo --out WORK/demo",
            "cp WORK/demo/grasps.png OUT/images/demo-grasps.png",
            "python -m benchmarks.webp WORK/demo/views.png OUT/images/demo-views.webp",
        ),
        (
            "graspd demo --out WORK/demo --hand barrett --object block -n 4 --scenes 1 --views 1 --fidelity draft",
            "cp WORK/demo/grasps.png OUT/images/demo-grasps.png",
        ),
        ALL,
        seeds=(0,),
    ),
    Study(
        "lift",
        "animation in the README: a hand lifts a mug",
        ("images/lift.webp",),
        (
            f"graspd synth --hand {_ALLEGRO} --object {_mesh('025_mug')} --scene table --faces all --scenes 8 -n 24 "
            "--seed 5 -o WORK/lift.h5",
            "graspd pictures WORK/lift.h5 --animate --row 13 -o OUT/images/lift.webp",
        ),
        (
            "graspd synth --hand barrett --object block --scene table --scenes 1 -n 1 -o WORK/lift.h5",
            "graspd pictures WORK/lift.h5 --animate --size 80 -o OUT/images/lift.webp",
        ),
        IN_SCENES,
        seeds=(5,),
    ),
    Study(
        "films",
        "animation of two episodes: an arm and a flying hand lift a mug",
        ("images/episodes.webp",),
        (
            "graspd synth --hand allegro --object mug --scene table -n 4 --seed 5 -o WORK/arm.h5",
            "graspd episodes create WORK/arm.h5 --arm ur10e --film scene,wrist --limit 4 --seed 2 -o WORK/film-arm.h5",
            "graspd synth --hand barrett --object mug --scene table -n 4 --seed 5 -o WORK/fly.h5",
            "graspd episodes create WORK/fly.h5 --film scene,wrist --limit 4 --seed 2 -o WORK/film-fly.h5",
            "python -m benchmarks.films WORK/film-arm.h5 WORK/film-fly.h5 -o OUT/images/episodes.webp",
        ),
        (
            "graspd synth --hand barrett --object block --scene table --scenes 1 -n 1 -o WORK/fly.h5",
            "graspd episodes create WORK/fly.h5 --film scene,wrist -o WORK/film-fly.h5",
            "python -m benchmarks.films WORK/film-fly.h5 -o OUT/images/episodes.webp",
        ),
        IN_SCENES,
        seeds=(5, 2),
    ),
    Study(
        "grasp-pictures",
        "pictures of grasps on many objects",
        ("images/grasps/*",),
        ("bash benchmarks/grasp_gallery.sh DATA OUT/images/grasps",),
        seeds=(4,),
    ),
    Study(
        "types",
        "pictures of the types of the GRASP taxonomy",
        ("images/types/*",),
        ("bash benchmarks/type_gallery.sh DATA OUT/images/types",),
        ("bash benchmarks/type_gallery.sh DATA OUT/images/types tripod",),
        seeds=(4,),
    ),
    Study(
        "choosing",
        "success of required types, contact regions and approach cones",
        ("results/choosing.md",),
        ("python -m benchmarks.choosing DATA --page OUT/results/choosing.md",),
        ("python -m benchmarks.choosing DATA --parts cones --grasps 2 --page OUT/results/choosing.md",),
        IN_SCENES,
        seeds=(1300,),
    ),
    Study(
        "scene-pictures",
        "pictures of scenes, approaches and neighbours",
        ("images/scenes/*",),
        (
            *_trajectory_pictures("shadow", "bottle", "table"),
            *_trajectory_pictures("allegro", "mug", "bin"),
            *_trajectory_pictures("barrett", "mug", "shelf"),
            *_trajectory_pictures("allegro", "block", "examples/scenes/beside_a_box.yaml"),
            "python -m benchmarks.scene_pictures --object mug --object bottle --object block "
            f"--object mustard={_mesh('006_mustard_bottle')} --object soup_can={_mesh('005_tomato_soup_can')} "
            f"--object drill={_mesh('035_power_drill')} --out OUT/images/scenes",
        ),
        (
            "graspd synth --hand barrett --object block --scene table --scenes 1 -n 1 -o WORK/trajectory.h5",
            "graspd pictures WORK/trajectory.h5 --trajectory -n 1 --size 120 --palette -o OUT/images/scenes/table.png",
        ),
        ALL,
    ),
    Study(
        "asset-pictures",
        "pictures of `graspd hands check` and `graspd objects check`",
        ("images/hands-*.png", "images/objects-*.png"),
        (
            f"graspd hands check {_ALLEGRO} --no-self-test --picture OUT/images/hands-guess.png",
            f"graspd hands check {_SHADOW} --no-self-test --picture OUT/images/hands-shadow.png",
            f"graspd hands check {_SHADOW} --root world --no-self-test --picture OUT/images/hands-forearm.png",
            f"graspd objects check {_mesh('011_banana')} --density 950 --picture OUT/images/objects-banana.png",
            f"graspd objects check {_mesh('koala')} --scale-to 0.14 --picture OUT/images/objects-koala.png",
        ),
        (f"graspd objects check {_mesh('011_banana')} --picture OUT/images/objects-banana.png",),
        stages=(),
    ),
    Study(
        "dashboard",
        "pictures of the dashboard",
        ("images/dashboard-*.png",),
        ("python -m benchmarks.screenshots --out OUT/images",),
        ("python -m benchmarks.screenshots --out OUT/images",),
        needs=(BROWSER,),
    ),
)
BY_NAME: Final = {study.name: study for study in STUDIES}


def files_of(study: Study, docs: Path) -> list[Path]:
    """Return the existing files of a study under a folder of the docs, including raw results."""
    globs = (*study.files, study.prints) if study.prints else study.files
    return sorted({file for glob in globs for file in docs.glob(glob) if file.is_file()})


def is_raw(path: str) -> bool:
    """Return whether a path under the folder of the docs is a raw result. Raw results are not in git."""
    return Path(path).suffix in RAW and path not in NOT_RAW
