"""The chunks of a sweep on Dask distributed: workers may die, join late, or be refused for their versions."""

import importlib.util
import logging
import socket
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits.io._errors import DataError, shown
from fits.sweeps._spec import Sweep, compute_chunk, parse_sweep
from fits.sweeps._store import need, versions
from fits.sweeps._types import Rows

_MOST_LOSSES = 5
# How long a scheduler without workers is waited for, without a word and at all; how often workers are looked for.
_SILENT_s, _GIVE_UP_s, _LOOK_s, _PAUSE_s = 5, 600, 1.0, 0.005
# What a worker has read stays with it.
_SWEEPS: dict[str, Sweep] = {}


@dataclass(frozen=True)
class _Payload:
    """What a worker needs to know of a sweep."""

    text: str
    name: str
    inputs: dict[str, bytes]
    folder: str
    digest: str
    versions: dict[str, str]


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Connect to a scheduler by its address, or to N processes of this machine by `local:N`, and give its client."""
    distributed = need("distributed")
    # What it tells of a lost scheduler is told here in a sentence.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    count = address.removeprefix("local:")
    if count != address and (not count.isdecimal() or not 1 <= int(count) <= 1024):
        raise DataError(f"cluster: expected local:N with a number of processes, found {shown(address)}; give one.")
    with ExitStack() as stack:
        try:
            where = address
            if count != address:
                with _memory_kept():
                    own = distributed.LocalCluster(
                        n_workers=int(count),
                        env={"NPROC": "1"},  # one thread of XLA in each worker, so that none is in another's way
                        threads_per_worker=1,
                        processes=True,
                        dashboard_address="127.0.0.1:0",  # any free port: another cluster may have the usual one
                        memory_limit=0,
                    )
                where = stack.enter_context(own).scheduler_address
            client = stack.enter_context(distributed.Client(where, timeout=20, set_as_default=False))
        except (OSError, TimeoutError, ValueError) as error:
            raise DataError(
                f"cluster: {address} does not answer ({error}); give the address of a Dask scheduler, such as "
                "tcp://host:8786, or local:2."
            ) from None
        yield client


def _memory_kept() -> Any:
    """Let workers keep memory for the next array: Dask has them return it each time, which costs a third of a fit."""
    config = need("dask").config
    name = "distributed.nanny.pre-spawn-environ"
    return config.set({name: {k: v for k, v in config.get(name).items() if k != "MALLOC_TRIM_THRESHOLD_"}})


def on_cluster(
    client: Any, sweep: Sweep, chunks: list[int], progress: Callable[[str], None]
) -> Iterator[tuple[int, Rows]]:
    """Compute chunks on the workers of a scheduler; a `DataError` says that it is lost, or has none to be used."""
    distributed = need("distributed")
    payload = _Payload(
        sweep.text, sweep.name, sweep.inputs, str(Path(sweep.name).resolve().parent), sweep.digest, versions()
    )
    try:
        waiting, losses = list(reversed(chunks)), Counter[int]()
        futures: dict[Any, int] = {}
        results, workers = distributed.as_completed(loop=client.loop), _Workers(client, progress)
        while waiting or futures:
            usable = workers.usable()
            # Two chunks wait per thread of the workers, so that none is idle.
            while waiting and len(futures) < 2 * sum(usable.values()):
                chunk = waiting.pop()
                # Should all of them die, others may have it: those that are refused give it back.
                chosen = {"workers": [*usable], "allow_other_workers": True} if workers.banned else {}
                future = client.submit(work, payload, chunk, pure=False, retries=0, **chosen)
                futures[future] = chunk
                results.add(future)
            asked = time.monotonic()
            while not (ready := results.next_batch(block=False)) and time.monotonic() - asked < _LOOK_s:
                time.sleep(_PAUSE_s)
            for future in ready:
                chunk = futures.pop(future)
                try:
                    worker, found = future.result()
                except (distributed.KilledWorker, ImportError) as error:
                    losses[chunk] += 1
                    if losses[chunk] > _MOST_LOSSES:
                        raise DataError(_often(chunk, error)) from None
                    waiting.append(chunk)
                    continue
                finally:
                    future.release()
                if isinstance(found, str):
                    workers.ban(worker, found)
                    waiting.append(chunk)
                else:
                    yield chunk, found
    except (OSError, distributed.client.FuturesCancelledError, distributed.CancelledError) as error:
        raise DataError(
            f"cluster: the scheduler was lost ({type(error).__name__}); what was computed is kept: start it again, "
            "then resume the sweep."
        ) from None


class _Workers:
    """The workers that are there, and those that are refused."""

    def __init__(self, client: Any, progress: Callable[[str], None]):
        self._client, self._progress = client, progress
        self._known: set[str] = set()
        self._seen = self._told = time.monotonic()
        self.banned: dict[str, str] = {}

    def usable(self) -> dict[str, int]:
        """Threads of each worker that may compute, by address; a `DataError` if all are refused, or none comes."""
        found = self._client.scheduler_info(n_workers=-1)["workers"]
        new = [address for address in found if address not in self._known]
        if new:
            # By value, so that it also runs where there is no microid.
            answers = self._client.run(
                lambda: importlib.util.find_spec("fits") is not None, workers=new, on_error="return"
            )
            for address, answer in answers.items():
                if answer is False:
                    self.ban(address, f"worker {found[address].get('name', address)} at {address} has no microid")
            self._known |= set(new)
        usable = {address: about["nthreads"] for address, about in found.items() if address not in self.banned}
        now = time.monotonic()
        if usable:
            self._seen = self._told = now
        elif self.banned:
            raise DataError(f"cluster: no worker can be used: {'; '.join(self.banned.values())}.")
        elif now - self._seen > _GIVE_UP_s:
            raise DataError(
                f"cluster: the scheduler has had no worker for {_GIVE_UP_s} s; what was computed is kept: start "
                "workers, then resume the sweep."
            )
        elif now - self._told > _SILENT_s:
            self._told = now
            self._progress(f"the scheduler has no worker; waiting for one, for up to {_GIVE_UP_s} s")
        return usable

    def ban(self, address: str, reason: str) -> None:
        if address not in self.banned:
            self.banned[address] = reason
            self._progress(f"refused: {reason}")


def _often(chunk: int, error: Exception) -> str:
    if isinstance(error, ImportError):
        return f"cluster: workers cannot import what they need ({error}); install the same microid on all of them."
    return (
        f"cluster: chunk {chunk} lost its worker {_MOST_LOSSES} times, as if it took too much memory; lower "
        "run.memory_MB, then resume the sweep."
    )


def work(payload: _Payload, chunk: int) -> tuple[str, Rows | str]:
    """Compute a chunk; this runs on a worker, whose address comes back, with the reason where it cannot."""
    from distributed import get_worker

    worker = get_worker()
    name = f"worker {worker.name} on {socket.gethostname()}"
    mine = versions()
    for package, version in payload.versions.items():
        if mine.get(package) != version:
            return worker.address, f"{name} has {package} {mine.get(package)}, and {version} is needed"
    try:
        return worker.address, compute_chunk(_sweep(payload), chunk)
    except (DataError, OSError, ImportError) as error:
        return worker.address, f"{name} cannot compute ({type(error).__name__}: {error})"


def _sweep(payload: _Payload) -> Sweep:
    if payload.digest not in _SWEEPS:
        from fits.io._jax_setup import start_jax

        start_jax(accelerator=True)
        sweep = parse_sweep(payload.text, payload.name, payload.inputs.__getitem__, Path(payload.folder))
        if sweep.digest != payload.digest:
            raise DataError(f"{payload.folder} holds other files there")
        _SWEEPS.clear()
        _SWEEPS[payload.digest] = sweep
    return _SWEEPS[payload.digest]
