"""Who is there: a controller, workers that fit to this graspd, and the port of the API."""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections import Counter
from contextlib import closing
from typing import Any, Final

from service.model.errors import QueueUnavailable
from service.model.finding import Finding, bad, good, skipped, warning
from service.model.states import Stage
from service.model.version import PACKAGE_VERSION
from service.model.worker_beat import WorkerBeat
from service.pipeline.leading import PART
from service.queue.rq_queue import RqQueue, open_queue
from service.run.address import recorded_address
from service.run.doctor.redis_server import is_there
from service.settings import Settings

_HTTP_S: Final = 5.0
_IDLE: Final = "no service runs on this data folder"
_AWAY: Final = "Redis does not answer"


def controller(settings: Settings) -> Finding:
    """Whether one gave a sign of life lately."""
    name = "controller"
    if not is_there(settings):
        return skipped(name, _IDLE)
    try:
        with closing(open_queue(settings, patience=0)) as queue:
            lives = queue.announced(PART)
    except QueueUnavailable:
        return skipped(name, _AWAY)
    if not lives:
        return bad(
            name,
            "no controller gave a sign of life: finished tasks are not taken up, and nothing is queued",
            "graspd controller",
        )
    return good(name, "a controller lives")


def workers(settings: Settings) -> Finding:
    """Whether every stage has a worker, of this version, that is fit."""
    name = "workers"
    if not is_there(settings):
        return skipped(name, _IDLE)
    try:
        with closing(open_queue(settings, patience=0)) as queue:
            return _judge_workers(name, queue.workers(), _waiting(queue))
    except QueueUnavailable:
        return skipped(name, _AWAY)


def _waiting(queue: RqQueue) -> Counter[Stage]:
    found: Counter[Stage] = Counter()
    for (_, stage), number in queue.depths().items():
        found[stage] += number
    return +found


def _judge_workers(name: str, beats: list[WorkerBeat], waiting: Counter[Stage]) -> Finding:
    if other := [beat for beat in beats if beat.version != PACKAGE_VERSION]:
        some = ", ".join(sorted({f"{beat.version} on {beat.host}" for beat in other})[:3])
        return bad(
            name,
            f"{len(other)} workers are of another version: {some}",
            f"install graspd {PACKAGE_VERSION} there as well",
        )
    if ill := [beat for beat in beats if beat.state == "quarantined"]:
        mend = f"on {ill[0].host}: graspd doctor --only gpu,kernels,disk"
        return bad(name, f"{len(ill)} workers are in quarantine, {ill[0].name}: {ill[0].reason}", mend)
    served = {stage for beat in beats for stage in beat.stages}
    if alone := sorted(stage.value for stage in waiting if stage not in served):
        tasks = sum(number for stage, number in waiting.items() if stage not in served)
        return bad(
            name,
            f"{tasks} tasks wait, and no worker takes {', '.join(alone)}",
            f"graspd worker --stages {','.join(alone)}",
        )
    if not beats:
        return warning(name, "there is none; nothing waits for one", "graspd worker, or graspd up --workers 1")
    states = Counter(beat.state for beat in beats)
    told = ", ".join(f"{number} {state}" for state, number in sorted(states.items()))
    return good(name, f"{told}, on {len({beat.host for beat in beats})} machines; {sum(waiting.values())} tasks wait")


def port(settings: Settings) -> Finding:
    """The API of this service: it answers, or its port is free."""
    name = "port"
    url = recorded_address(settings.data_dir)
    if url is None and "api_url" in settings.model_fields_set:
        url = settings.api_url
    if url is not None:
        return _judge_api(name, url)
    where = f"{settings.host}:{settings.port}"
    if settings.port and (found := _readyz(f"http://{_reachable(settings.host)}:{settings.port}")) is not None:
        if found:
            return _judge_api(name, f"http://{_reachable(settings.host)}:{settings.port}")
        return bad(
            name, f"{where} is taken by something that is no graspd", "stop it, or set GRASPD_PORT (0: any free one)"
        )
    return _bind(name, settings, where)


def _judge_api(name: str, url: str) -> Finding:
    found = _readyz(url)
    if found is None:
        return bad(
            name,
            f"no API answers at {url}",
            "start graspd up or graspd api there; see proxy, firewall and GRASPD_API_URL",
        )
    if not found:
        return bad(name, f"what answers at {url} is no graspd", "set GRASPD_API_URL to the address of the API")
    if not found.get("ok"):
        away = [part for part, state in found["parts"].items() if not state.get("ok")]
        return bad(name, f"the API at {url} is not ready: {', '.join(away)}", "see these parts above")
    return good(name, f"the API at {url} is ready")


def _readyz(url: str) -> dict[str, Any] | None:
    """The answer of an API; {} if it is not one of graspd's, None if nothing answers."""
    opener = (
        urllib.request.build_opener(urllib.request.ProxyHandler({}))
        if "//127.0.0.1" in url
        else urllib.request.build_opener()
    )
    try:
        with opener.open(f"{url.rstrip('/')}/readyz", timeout=_HTTP_S) as answer:
            body = answer.read(65536)
    except urllib.error.HTTPError as error:
        body = error.read(65536)
    except (OSError, ValueError) as error:
        # A server of another protocol closes or babbles; a port without one refuses.
        refused = isinstance(getattr(error, "reason", error), ConnectionRefusedError | socket.gaierror | TimeoutError)
        return None if refused else {}
    except Exception:
        return {}
    try:
        found = json.loads(body)
    except ValueError:
        return {}
    return found if isinstance(found, dict) and isinstance(found.get("parts"), dict) else {}


def _reachable(host: str) -> str:
    return {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)


def _bind(name: str, settings: Settings, where: str) -> Finding:
    try:
        with closing(socket.create_server((settings.host, settings.port))):
            return good(name, f"{where} is free")
    except OSError as error:
        mend = "set GRASPD_HOST to an address of this machine, and GRASPD_PORT to a port above 1023"
        return bad(name, f"{where} cannot be bound: {error.strerror or error}", mend)
