"""Chunks on a scheduler: without workers, with one that has no microid, and with processes that are killed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from _command import OFF
from _sweeps import parsed, small

from fits import DataError
from fits.sweeps import _cluster, _store
from fits.sweeps._run import run_sweep

distributed = pytest.importorskip("distributed", reason="the extra cluster is not installed")
ROOT = Path(__file__).parents[1]
SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"
WORKER = "from distributed.cli.dask_worker import main; main()"
BARE = "import sys; sys.modules['fits'] = None; " + WORKER


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler's process, its address, and what starts further processes; all end with the test."""
    started, file = [], tmp_path / "scheduler.json"

    def start(code, *arguments):
        process = subprocess.Popen(
            [sys.executable, "-c", code, *arguments],
            cwd=ROOT,
            env=os.environ | OFF | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        started.append(process)
        return process

    first = start(SCHEDULER, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    for _ in range(600):
        if file.exists() and file.stat().st_size:
            break
        time.sleep(0.1)
    address = json.loads(file.read_text())["address"]

    def worker(code=WORKER, name="one"):
        return start(code, address, "--no-nanny", "--no-dashboard", "--nthreads", "1", "--name", name)

    yield first, address, worker
    for process in started:
        process.kill()
        process.wait()


def test_no_workers_and_one_without_microid_are_sentences(scheduler, tmp_path, monkeypatch, seed):
    _, address, worker = scheduler
    monkeypatch.setattr(_cluster, "_SILENT_s", 0.5)
    monkeypatch.setattr(_cluster, "_GIVE_UP_s", 2)
    told = []
    with pytest.raises(DataError, match="had no worker for 2 s"):
        run_sweep(parsed(small(seed)), str(tmp_path / "a"), cluster=address, progress=told.append)
    assert any("waiting" in line for line in told)
    monkeypatch.setattr(_cluster, "_GIVE_UP_s", 120)
    worker(BARE, "bare")
    with pytest.raises(DataError, match=r"no worker can be used: worker bare at .* has no microid"):
        run_sweep(parsed(small(seed)), str(tmp_path / "b"), cluster=address)


def test_what_a_worker_cannot_read_refuses_that_worker(monkeypatch):
    def full(payload):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("distributed.get_worker", lambda: type("Worker", (), {"name": "w", "address": "tcp://w:1"}))
    monkeypatch.setattr(_cluster, "_sweep", full)
    address, refused = _cluster.work(_cluster._Payload("", "", {}, "", "", _cluster.versions()), 0)
    assert address == "tcp://w:1"
    assert "worker w on" in refused
    assert "No space left" in refused


def test_own_workers_need_not_return_memory_after_each_array():
    with _cluster.connected("local:1") as client:
        assert list(client.run(os.environ.get, "MALLOC_TRIM_THRESHOLD_").values()) == [None]


@pytest.mark.study
def test_a_killed_worker_and_a_killed_scheduler_lose_no_row(scheduler, tmp_path, monkeypatch, seed):
    first, address, worker = scheduler
    sweep, out = parsed(small(seed, rows=3000)), tmp_path / "out"
    workers, written, write = [worker()], [], _store.Store.write

    def deadly(store, chunk, rows):
        write(store, chunk, rows)
        written.append(chunk)
        if len(written) == 2:
            workers[0].send_signal(signal.SIGKILL)
            workers.append(worker(name="late"))
        if len(written) == 6:
            first.send_signal(signal.SIGKILL)

    monkeypatch.setattr(_store.Store, "write", deadly)
    with pytest.raises(DataError, match="the scheduler was lost"):
        run_sweep(sweep, str(out), cluster=address)
    monkeypatch.setattr(_store.Store, "write", write)
    assert len(written) == len(set(written)) >= 6
    outcome = run_sweep(sweep, str(out), resume=True)
    assert outcome.computed == 3000 - 256 * len(written)
    run_sweep(sweep, str(tmp_path / "whole"))
    here, there = (pd.read_parquet(folder / "results.parquet") for folder in (out, tmp_path / "whole"))
    assert here.equals(there)
