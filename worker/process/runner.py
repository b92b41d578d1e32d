"""Run a task's stage and convert its result or error to an outcome."""

import errno
import logging
import os
import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final

from pydantic import ValidationError

from graspd.service.model import errors, messages, names
from graspd.service.model.clock import timestamp
from graspd.service.model.planning import format_outcomes, phase_seconds
from graspd.service.model.records import AttemptRecord
from graspd.service.model.renamed import convert_names
from graspd.service.model.states import Stage
from graspd.service.queue.port import Event, EventKind, Message
from graspd.service.store.manifests import ShardManifest, load_manifest, publish_shard, shard_exists
from graspd.service.store.records import put_record
from graspd.service.telemetry import bind_subjects
from graspd.worker.engines.devices import DeviceLost, check_device
from graspd.worker.pool.pool import ProcessLost
from graspd.worker.process.fitness import Fitness, is_first_loss
from graspd.worker.stages.context import StageFunction, StopReason, TaskContext, build_shard

log = logging.getLogger(__name__)
_TRACE_CHARACTERS: Final = 8000
_STOPPED: Final = {StopReason.CANCELLED: EventKind.CANCELLED, StopReason.SHUTDOWN: EventKind.RETURNED}


class Runner:
    """Runs tasks one by one with a table of stages."""

    def __init__(
        self,
        stages: Mapping[Stage, StageFunction],
        *,
        worker: str,
        publish: Callable[[Event], None],
        fitness: Fitness | None = None,
        check_device: Callable[[str], None] = check_device,
    ) -> None:
        """`check_device` raises DeviceLost once a device no longer works."""
        self._stages, self._worker, self._publish = stages, worker, publish
        self._fitness, self._check_device = fitness, check_device
        self.device_lost = ""  # reason why this process can run no more tasks on its device; "" while it can

    def run(self, raw: Mapping[str, Any], context: TaskContext) -> Event | None:
        """Run a task; return the event for the controller, None if the task no longer belongs to this worker.
        Raises TaskRefused: the message cannot be read, so there is no task that could fail."""
        message = parse_message(raw)
        with bind_subjects(**_subjects(message)):
            return self._run(message, raw, context)

    def _run(self, message: Message, raw: Mapping[str, Any], context: TaskContext) -> Event | None:
        started, clock = timestamp(), time.monotonic()
        try:
            if lacking := messages.capabilities().unmet_requirement(messages.requirements_of(message)):
                # The task is for another worker. The controller reports tasks that no present worker can do.
                return self._create_event(EventKind.DEFERRED, message, message=f"this worker cannot run it: {lacking}")
            return self._run_stage(message, context)
        except errors.TaskCancelled:
            return self._stopped_event(message, context, started)
        except errors.UnavailableError as error:
            return self._create_event(EventKind.DEFERRED, message, message=str(error))
        except Exception as error:
            if is_disk_full(error):
                why = f"{os.strerror(errno.ENOSPC)}: {_one_line(error)}"
                return self._create_event(EventKind.DEFERRED, message, message=why)
            if (why := self._describe_loss(error, context)) and is_first_loss(message.task_id):
                log.error("the task is returned to the queue: %s", why, exc_info=True)
                return self._create_event(EventKind.RETURNED, message, message=why)
            if not why and self._fitness is not None and (why := self._fitness.diagnose(message, error)):
                log.warning("the task is returned to the queue; it failed because of this worker", exc_info=True)
                return self._create_event(EventKind.RETURNED, message, message=why)
            return self._failure_event(message, error, context, started)
        finally:
            log.info("%s took %.2f s", message.stage, time.monotonic() - clock)

    def _run_stage(self, message: Message, context: TaskContext) -> Event:
        context.check()
        output = output_id(message)
        if self._is_done(message, context):
            return self._create_event(EventKind.FINISHED, message, output=output, message="was there already")
        if message.stage not in self._stages:
            raise errors.TaskRefused(f"this worker does no {message.stage} tasks")
        self._publish(self._create_event(EventKind.STARTED, message))
        clock = time.perf_counter()
        lost = self._lost_manifest(message, context)
        made = self._stages[message.stage](message, context)
        self._check_device(context.device)
        seconds = time.perf_counter() - clock
        if made is not None and isinstance(message, messages.TaskMessage):
            phases = [f"{name} {time_s:.2f} s" for name, time_s in phase_seconds(made.info).items()]
            rejected = format_outcomes(made.info.get("outcomes", {}))
            log.info("computed in %.2f s; %s", seconds, "; ".join([*phases, f"rejected: {rejected or 'none'}"]))
            context.check()
            device, worker = context.device, self._worker
            made = replace(made, info={**made.info, "log": context.log()})
            manifest, data = build_shard(message, made, device=device, seconds=seconds, worker=worker, lost=lost)
            if lost is not None and manifest.sha256 != lost.sha256:
                raise errors.DamagedShard(
                    f"{lost.key} was made again with another content: first on {lost.device} by graspd "
                    f"{lost.code_version}, now on {device}; restore a copy"
                )
            publish_shard(context.store, manifest, data)
        if self._fitness is not None:
            self._fitness.record_success()
        return self._create_event(EventKind.FINISHED, message, output=output, seconds=seconds)

    def _describe_loss(self, error: Exception, context: TaskContext) -> str:
        """Return how the device or a pool process was lost if that caused the error; else ""."""
        try:
            self._check_device(context.device)
        except DeviceLost as lost:
            error = lost
        if isinstance(error, DeviceLost):
            self.device_lost = str(error)
        return str(error) if isinstance(error, ProcessLost) else self.device_lost

    def _is_done(self, message: Message, context: TaskContext) -> bool:
        if isinstance(message, messages.IngestMessage):
            return context.store.exists(names.asset_key(message.kind, message.digest, "check.json"))
        file = names.shard_file_key(message.stage, message.output)
        return shard_exists(context.store, message.stage, message.output) and context.store.exists(file)

    def _lost_manifest(self, message: Message, context: TaskContext) -> ShardManifest | None:
        """Return the manifest of a shard that was made before but has lost its file."""
        if isinstance(message, messages.IngestMessage) or not shard_exists(
            context.store, message.stage, message.output
        ):
            return None
        return load_manifest(context.store, message.stage, message.output)

    def _stopped_event(self, message: Message, context: TaskContext, started: str) -> Event | None:
        reason = context.stop_reason
        if reason is StopReason.TIMEOUT:
            error = TimeoutError("the task exceeded the time limit GRASPD_TASK_TIMEOUT_S")
            return self._failure_event(message, error, context, started)
        kind = _STOPPED.get(reason) if reason is not None else EventKind.CANCELLED
        return None if kind is None else self._create_event(kind, message, output=output_id(message))

    def _failure_event(self, message: Message, error: Exception, context: TaskContext, started: str) -> Event:
        log.warning("task failed: %s", error, exc_info=not isinstance(error, errors.InputError))
        # Retries fix neither invalid input nor a damaged store.
        last = (
            isinstance(error, errors.InputError | errors.DamagedError | errors.TaskRefused)
            or message.attempt >= message.max_attempt
        )
        attempt = AttemptRecord.from_message(
            message,
            kind=type(error).__name__,
            reason=_one_line(error),
            trace="".join(traceback.format_exception(error))[-_TRACE_CHARACTERS:],
            worker=self._worker,
            started=started,
            last=last,
            log=context.log(),
        )
        try:
            if isinstance(message, messages.TaskMessage) and _has_manifest(message, context):
                # The task has already succeeded: another worker was faster, or a lost file could not be made again.
                return self._create_event(EventKind.CANCELLED, message, message=attempt.reason)
            put_record(context.store, names.attempt_key(attempt.task_id, attempt.number), attempt)
        except errors.UnavailableError as error:
            return self._create_event(EventKind.DEFERRED, message, message=f"{attempt.reason}; {error}")
        return self._create_event(EventKind.FAILED, message, message=attempt.reason, last=attempt.last)

    def _create_event(self, kind: EventKind, task: Message, **more: Any) -> Event:
        facts: dict[str, Any] = {"output": output_id(task), "stage": task.stage, "attempt": task.attempt}
        if isinstance(task, messages.TaskMessage):
            facts |= {"job_id": task.job_id, "batch": task.batch}
        return Event(kind=kind, at=timestamp(), task_id=task.task_id, worker=self._worker, **facts | more)


def _has_manifest(message: messages.TaskMessage, context: TaskContext) -> bool:
    try:
        return load_manifest(context.store, message.stage, message.output).shard_id == message.output
    except (errors.NotFoundError, errors.DamagedError):
        return False


def parse_message(raw: Mapping[str, Any]) -> Message:
    """Parse the message of a queue entry; raise TaskRefused if it is invalid."""
    try:
        model = messages.message_type(raw)
        # A newer schema may have more fields. Fields that identify the task must exist, so that it can be refused.
        known = {field.alias or name for name, field in model.model_fields.items()}
        return model.model_validate({key: value for key, value in convert_names(dict(raw)).items() if key in known})
    except (ValidationError, AttributeError) as error:
        raise errors.TaskRefused(f"an entry of the queue is no task of graspd: {_one_line(error)}") from None


def _subjects(message: Message) -> dict[str, Any]:
    found: dict[str, Any] = {"task": message.task_id, "attempt": message.attempt}
    if isinstance(message, messages.TaskMessage):
        origin = message.origin or messages.Origin()
        found |= {"job": message.job_id, "request": origin.request, "key": origin.key}
    return found


def output_id(message: Message) -> str:
    """Return the output of a task: a shard id, or kind and digest of the checked asset."""
    return message.output if isinstance(message, messages.TaskMessage) else f"{message.kind.value}/{message.digest}"


def is_disk_full(error: BaseException | None) -> bool:
    """Check whether an error or its cause is a full disk or quota."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        error = error.__cause__ or error.__context__
    return False


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:500] or type(error).__name__
