"""Several workers by one command: numbered, started again, ended together."""

import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

from graspd.commands.worker import run_workers
from graspd.service.settings import Settings
from tests.system.conftest import alive
from tests.waiting import until

#: Notes its pid under its number and waits.
PROGRAM = (
    "import os, pathlib, sys, time\n"
    "number = os.environ['GRASPD_WORKER_NUMBER']\n"
    "note = pathlib.Path(sys.argv[1]) / f'{number}-{os.getpid()}'\n"
    "note.touch()\n"
    "time.sleep(600)\n"
)


def test_each_has_a_number_and_one_that_ends_comes_again(tmp_path: Path) -> None:
    stop = threading.Event()
    run = partial(run_workers, 3, [str(tmp_path)], Settings(), stop, program=(sys.executable, "-c", PROGRAM))
    running = threading.Thread(target=run)
    running.start()

    def notes(count: int) -> list[tuple[int, int]]:
        until(lambda: len(list(tmp_path.iterdir())) >= count, f"{count} processes start")
        found = [file.name.split("-") for file in tmp_path.iterdir()]
        return sorted((int(number), int(pid)) for number, pid in found)

    try:
        first = notes(3)
        assert [number for number, _ in first] == [0, 1, 2]
        subprocess.run(["kill", "-9", str(first[1][1])], check=True)
        (again,) = set(notes(4)) - set(first)
        assert again[0] == 1
    finally:
        stop.set()
        running.join()
    assert not any(alive(pid) for _, pid in notes(4))


_ENDING = """
import atexit
from graspd.worker.process.engine import exit_process

class Engine:
    def __del__(self):
        print("taken apart", flush=True)

engine = Engine()
atexit.register(print, "what waited was sent", flush=True)
exit_process()
"""


def test_an_engine_ends_at_once_without_being_taken_apart() -> None:
    """Warp and its kernels take two seconds of computing for that: too long for a busy machine to wait for."""
    done = subprocess.run([sys.executable, "-c", _ENDING], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "what waited was sent\n"), done.stderr
