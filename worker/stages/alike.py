"""Which tasks may be done together: those whose grasps one launch can plan."""

from __future__ import annotations

import json
from collections.abc import Hashable

from service.model.errors import InputError
from service.model.messages import TaskMessage
from service.model.states import Stage
from worker.planners import method


def alike(message: TaskMessage) -> Hashable | None:
    """The same for tasks that may be done together; None: by itself.

    A task that was tried before is done by itself: should it end its worker again, it takes no other one along.
    """
    request = message.request
    if message.stage is not Stage.SYNTHESIZE or message.attempt > 1 or message.max_attempt == 1:
        return None
    try:
        if method(request.method).joined is None:
            return None
        knobs = request.knobs.model_dump(mode="json")
    except (InputError, ValueError):  # for the task itself to say
        return None
    beside = [(one.object, one.digest) for one in request.beside]
    told = [request.method, request.options, knobs, request.place.told(), beside]
    pair = (request.hand, message.hand_digest, request.object, message.object_digest)
    return (*pair, json.dumps(told, sort_keys=True, default=str))
