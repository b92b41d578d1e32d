"""Kernel launches, recorded once and run many times with the same arguments."""

import ctypes
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import cache, partial
from typing import Any

import warp as wp


class Launches:
    """Ordered launches; on CUDA, more than two runs in one call use a captured graph."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._commands: list[tuple[str, Any]] = []
        self._calls: list[Callable[[], object]] = []
        self._arguments: list[Any] = []
        self._graph: Any = None

    def add(self, kernel: Any, dim: int | tuple[int, ...], *, inputs: list[Any], outputs: list[Any]) -> None:
        """Append a launch over `dim`; its arrays live as long as the list."""
        command = wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device, record_cmd=True)
        self._commands.append((kernel.key.rpartition(".")[2], command))
        self._calls.append(_packed_call(command))
        self._arguments.append((inputs, outputs))
        self._graph = None

    def named_commands(self) -> list[tuple[str, Any]]:
        return list(self._commands)

    def run(self, times: int = 1) -> None:
        """Run all launches `times` times without waiting for the device."""
        if not wp.get_device(self.device).is_cuda:
            with _count_cpu_time():
                for _ in range(times):
                    for call in self._calls:
                        call()
            return
        launch_all: Callable[[], object] = self._launch_all
        if times > 2:
            if self._graph is None:
                with wp.ScopedCapture(device=self.device) as capture:
                    self._launch_all()
                self._graph = capture.graph
            launch_all = partial(wp.capture_launch, self._graph)
        for _ in range(times):
            launch_all()

    def _launch_all(self) -> None:
        for _, command in self._commands:
            command.launch()


def launch(kernel: Any, dim: Any, *, device: Any = None, **given: Any) -> None:
    """Run `warp.launch` and count the CPU time of its kernel while `kernel_seconds` is active."""
    with nullcontext() if wp.get_device(device).is_cuda else _count_cpu_time():
        wp.launch(kernel, dim, device=device, **given)


#: CPU seconds of kernels on the CPU, while `kernel_seconds` is active.
_spent: ContextVar[list[float] | None] = ContextVar("spent", default=None)


@contextmanager
def kernel_seconds() -> Iterator[list[float]]:
    """Count the CPU seconds of the kernels that this thread runs on the CPU."""
    spent: list[float] = []
    token = _spent.set(spent)
    try:
        yield spent
    finally:
        _spent.reset(token)


@contextmanager
def _count_cpu_time() -> Iterator[None]:
    spent = _spent.get()
    if spent is None:
        yield
        return
    began = time.thread_time()
    try:
        yield
    finally:
        spent.append(time.thread_time() - began)


def _packed_call(command: Any) -> Callable[[], object]:
    """Return a function that runs a recorded launch, on the CPU with arguments that are packed in advance.
    Warp would pack them at each launch under the interpreter's lock, and other threads would wait."""
    if not command.device.is_cpu or command.adjoint or command.block_dim > 1:
        return partial(command.launch)
    bounds, *values = command.params
    arguments = _argument_struct(tuple(type(value) for value in values))(*values)
    return partial(command.hooks.forward, ctypes.byref(bounds), ctypes.byref(arguments))


@cache
def _argument_struct(types: tuple[type, ...]) -> type[ctypes.Structure]:
    fields = [(f"argument{k}", kind) for k, kind in enumerate(types)]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})
