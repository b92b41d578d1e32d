"""Kernel launches fixed once and run many times: nothing but counters on the device changes between two runs."""

from __future__ import annotations

from typing import Any

import warp as wp


class Launches:
    """A list of launches in order; on CUDA it becomes a graph as soon as it is run often enough."""

    def __init__(self, device: str) -> None:
        self.device = device
        self._commands: list[tuple[str, Any]] = []
        self._arguments: list[Any] = []
        self._graph: Any = None

    def add(self, kernel: Any, dim: int | tuple[int, ...], *, inputs: list[Any], outputs: list[Any]) -> None:
        """Append a launch over `dim`; its arrays live as long as the list does."""
        command = wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device, record_cmd=True)
        self._commands.append((kernel.key.rpartition(".")[2], command))
        self._arguments.append((inputs, outputs))
        self._graph = None

    def named(self) -> list[tuple[str, Any]]:
        """Name and launch of each kernel, in order."""
        return list(self._commands)

    def run(self, times: int = 1) -> None:
        """Launch all, so many times, without waiting for the device."""
        if wp.get_device(self.device).is_cuda and times > 2:
            if self._graph is None:
                with wp.ScopedCapture(device=self.device) as capture:
                    self._launch_all()
                self._graph = capture.graph
            for _ in range(times):
                wp.capture_launch(self._graph)
            return
        for _ in range(times):
            self._launch_all()

    def _launch_all(self) -> None:
        for _, command in self._commands:
            command.launch()
