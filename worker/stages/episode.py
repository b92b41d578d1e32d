"""Stage episode: a robot executes the valid grasps of a base shard."""

import numpy as np

from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage
from graspd.service.store.columns import Attribute
from graspd.worker.episodes.film import FilmOptions, cameras_attribute, film_maker
from graspd.worker.episodes.shard import EpisodeOptions, record_episodes
from graspd.worker.stages import assets
from graspd.worker.stages.context import Output, TaskContext, batch_seed

#: Attributes that a job's shard has from its task.
_OF_TASK = ("seed", "batch", "device", "seconds")


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Execute the valid grasps of the base shard. Raises InputError: the robot cannot carry the hand."""
    request, store = message.request, context.store
    base = assets.load_input(message, context, Stage.SYNTHESIZE)
    hand, obj = assets.hand_of(store, message), assets.object_of(store, message)
    of_scenes = np.asarray(base["grasp/scene_index"], np.intp)
    placed = assets.scenes_of(store, message, base.arrays).placed(of_scenes)
    arm = None if request.episodes == "flying" else request.episodes
    options = EpisodeOptions(arm, fps=request.episode_fps, seed=batch_seed(message))
    pieces = assets.load_pieces(store, obj)
    films = FilmOptions(request.film, request.width, request.height, request.episode_fps)
    film = film_maker(base, films, options.seed, context.run) if request.film else None
    columns, found = record_episodes(
        base, hand, obj, placed, options, pieces=pieces, film=film, empty=True, run=context.run
    )
    attributes: dict[str, Attribute] = {name: value for name, value in found.items() if name not in _OF_TASK}
    attributes |= {"cameras": cameras_attribute(films)} if film else {}
    attributes |= {"base_shard": message.inputs[0], "scene_shard": base.attributes["scene_shard"]}
    return Output(columns, attributes)
