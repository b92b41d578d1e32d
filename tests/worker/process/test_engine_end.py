"""End of an engine that refuses its worker, while an order is on its way."""

from __future__ import annotations

import os
import struct
import threading
from multiprocessing import Pipe
from pathlib import Path

import pytest

from graspd.service.model.states import Stage
from graspd.service.settings import Settings
from graspd.worker.process.engine import Engine
from graspd.worker.process.link import Setup
from tests.waiting import until


def test_half_an_order_does_not_break_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", broken.append)
    ours, theirs = Pipe()
    settings = Settings(data_dir=tmp_path, store_url=f"file://{tmp_path}/store", device="cuda:99")
    header = struct.pack("!i", 1)
    os.write(ours.fileno(), header[:2])
    Engine(theirs, Setup(settings, tuple(Stage), "a-worker", patient=False)).serve()
    assert ours.recv()[0] == "refused"
    os.write(ours.fileno(), header[2:])
    until(lambda: "engine-orders" not in {thread.name for thread in threading.enumerate()}, "its listener ends")
    assert not broken, broken[0].exc_value
