"""The chunks of a sweep on Dask distributed: workers may die, join late, or be refused for their versions."""

import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fits._errors import DataError
from fits.sweeps._chunks import compute_chunk
from fits.sweeps._extra import need
from fits.sweeps._spec import Sweep, parse_sweep
from fits.sweeps._types import Rows
from fits.sweeps._versions import versions

# Chunks that wait per thread of the workers, so that none is idle; and how often a chunk may lose its worker.
_AHEAD, _LOSSES = 2, 5
_CONNECT_s = 20
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


@dataclass(frozen=True)
class _Answer:
    """A chunk, or why this worker cannot compute it."""

    worker: str
    rows: Rows | None
    refused: str = ""


def on_cluster(
    sweep: Sweep, chunks: list[int], address: str, progress: Callable[[str], None]
) -> Iterator[tuple[int, Rows]]:
    """Compute chunks on the workers of a scheduler and give them back as they come.

    Parameters
    ----------
    sweep, chunks
        What is to be computed.
    address
        Of a scheduler, or `local:N` for N processes of this machine.
    progress
        Told of workers that are refused.

    Raises
    ------
    DataError
        If there is no scheduler, it is lost, or no worker has the versions of this process.
    """
    distributed = need("distributed")
    # What it tells of a lost scheduler is told here in a sentence.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    if not chunks:
        return
    with ExitStack() as stack:
        try:
            client = _client(distributed, address, stack)
        except (OSError, TimeoutError, ValueError) as error:
            raise DataError(
                f"--cluster: {address} does not answer ({error}); give the address of a Dask scheduler, such as "
                "tcp://host:8786, or local:2."
            ) from None
        try:
            yield from _all(distributed, client, sweep, chunks, progress)
        except (OSError, distributed.client.FuturesCancelledError, distributed.CancelledError) as error:
            raise DataError(
                f"--cluster: the scheduler {address} was lost ({type(error).__name__}); what was computed is kept: "
                "start it again, then go on with --resume."
            ) from None


def _client(distributed: Any, address: str, stack: ExitStack) -> Any:
    if address.startswith("local:"):
        count = address.removeprefix("local:")
        if not count.isdigit() or not 1 <= int(count) <= 1024:
            raise DataError(
                f"--cluster: expected local:N with a number of processes, found {address!r}; write local:2."
            )
        address = stack.enter_context(
            distributed.LocalCluster(
                n_workers=int(count), threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
            )
        ).scheduler_address
    return stack.enter_context(distributed.Client(address, timeout=_CONNECT_s, set_as_default=False))


def _all(
    distributed: Any, client: Any, sweep: Sweep, chunks: list[int], progress: Callable[[str], None]
) -> Iterator[tuple[int, Rows]]:
    payload = _Payload(
        sweep.text, sweep.name, sweep.inputs, str(Path(sweep.name).resolve().parent), sweep.digest, versions()
    )
    waiting, banned, losses = list(reversed(chunks)), dict[str, str](), dict[int, int]()
    futures: dict[Any, int] = {}
    results = distributed.as_completed(loop=client.loop)
    while waiting or futures:
        workers = {
            name: about
            for name, about in client.scheduler_info(n_workers=-1)["workers"].items()
            if name not in banned
        }
        if not workers and banned:
            raise DataError(f"--cluster: no worker can be used: {'; '.join(banned.values())}.")
        room = _AHEAD * max(1, sum(about["nthreads"] for about in workers.values()))
        while waiting and len(futures) < room:
            chunk = waiting.pop()
            future = client.submit(
                work, payload, chunk, pure=False, workers=[*workers] if banned else None, retries=0
            )
            futures[future] = chunk
            results.add(future)
        future = next(results)
        chunk = futures.pop(future)
        try:
            answer: _Answer = future.result()
        except distributed.KilledWorker:
            losses[chunk] = losses.get(chunk, 0) + 1
            if losses[chunk] > _LOSSES:
                raise DataError(
                    f"--cluster: chunk {chunk} lost its worker {_LOSSES} times, as if it took too much memory; lower "
                    "run.memory_MB, then go on with --resume."
                ) from None
            waiting.append(chunk)
            continue
        finally:
            future.release()
        if answer.rows is None:
            if answer.worker not in banned:
                banned[answer.worker] = answer.refused
                progress(f"refused: {answer.refused}")
            waiting.append(chunk)
            continue
        yield chunk, answer.rows


def work(payload: _Payload, chunk: int) -> _Answer:
    """Compute a chunk; this runs on a worker."""
    from distributed import get_worker

    worker = get_worker()
    name = f"worker {worker.name} on {socket.gethostname()}"
    mine = versions()
    for package, version in payload.versions.items():
        if mine.get(package) != version:
            reason = f"{name} has {package} {mine.get(package)}, and {version} is needed"
            return _Answer(worker.address, None, reason)
    if payload.digest not in _SWEEPS:
        from fits._cli_jax import start_jax

        start_jax()
        sweep = parse_sweep(payload.text, payload.name, payload.inputs.__getitem__, Path(payload.folder))
        if sweep.digest != payload.digest:
            return _Answer(worker.address, None, f"{name} sees other files in {payload.folder}")
        _SWEEPS.clear()
        _SWEEPS[payload.digest] = sweep
    return _Answer(worker.address, compute_chunk(_SWEEPS[payload.digest], chunk))
