"""A Dask cluster of others', or one of processes here.

The address of others' leads to a scheduler, which has workers, or a user is told what is missing. Dask is imported
where it is used: who only shows results does not wait for it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import CancelledError, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from tqdm.auto import tqdm

if TYPE_CHECKING:
    from dask.distributed import Client, Future

ANSWER = 10.0  # s that a scheduler has to answer
PATIENCE = 30.0  # s that it has to take a client, and to have a worker before it is said that there is none
LOOK = 1.0  # s between two looks at the workers
AWAKE = {"distributed.scheduler.worker-ttl": None}  # a machine that slept loses no worker, silent as it was
# nobody else is to reach scheduler, workers and their pages
LOOPBACK = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0", "silence_logs": "ERROR"}


def open_client(scheduler: str) -> Client:
    """A client of the scheduler at an address; ValueError where nothing answers there as Dask does."""
    from dask.distributed import Client

    return Client(check_scheduler("scheduler", scheduler), timeout=PATIENCE)


def check_scheduler(name: str, address: str) -> str:
    """The address, if a Dask scheduler answers there; ValueError, which says ``name``, where none does."""
    try:
        with ThreadPoolExecutor(1) as thread:  # in this one a notebook's own loop runs
            thread.submit(asyncio.run, asyncio.wait_for(_greet(address), ANSWER)).result()
    except Exception as error:  # whatever it is that another program's answer does to Dask's reader
        raise ValueError(
            f"{name} must be an address host:port or tcp://host:port of a Dask scheduler, got {address!r}, where none "
            "answers: take the one that `dask scheduler` prints when it starts"
        ) from error
    return address


async def _greet(address: str) -> None:
    """A client would wait for ever where somebody listens and says nothing."""
    from dask.distributed import Security
    from distributed.comm import connect

    comm = await connect(address, timeout=ANSWER, **Security().get_connection_args("client"))
    comm.abort()


@contextlib.contextmanager
def open_processes(count: int) -> Iterator[Client]:
    """A client of ``count`` processes on this machine, which end with this one; each does a task at a time."""
    with _open_cluster(n_workers=count, threads_per_worker=1, host="127.0.0.1", memory_limit=0) as client:
        yield client


@contextlib.contextmanager
def open_threads(count: int = 0) -> Iterator[Client]:
    """A client of ``count`` threads of this process (0: one a core that it may use), for tasks that wait for others."""
    from dask.system import cpu_count  # affinity and quotas count

    with _open_cluster(n_workers=1, threads_per_worker=count or cpu_count(), processes=False) as client:
        yield client


@contextlib.contextmanager
def _open_cluster(**how: Any) -> Iterator[Client]:
    import dask
    from dask.distributed import Client, LocalCluster

    with (
        unchanged_environment(), dask.config.set(AWAKE),
        LocalCluster(**how, **LOOPBACK) as cluster, Client(cluster) as client,
    ):  # fmt: skip
        yield client


@contextlib.contextmanager
def unchanged_environment() -> Iterator[None]:
    """Dask sets OMP_NUM_THREADS=1 and more in this process for good: a training later on would get a single thread."""
    before = dict(os.environ)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


@contextlib.contextmanager
def run_tasks(
    client: Client, function: Callable[[Any], Any], tasks: Mapping[str, Any], *, retries: int = 0
) -> Iterator[Iterator[tuple[str, Any]]]:
    """Names and results of a function of each task, as they are done.

    After an error or a Ctrl-C none of the rest is begun.
    """
    futures = {client.submit(function, task, pure=False, retries=retries): name for name, task in tasks.items()}
    try:
        yield ((futures.pop(future), future.result()) for future in wait_for_each(client, list(futures)))
    finally:
        client.cancel(list(futures))


def wait_for_each(client: Client, futures: Collection[Future]) -> Iterator[Future]:
    """The futures as they are done; where the cluster has no worker it says so, and goes on as soon as one joins.

    RuntimeError where the scheduler itself is lost.
    """
    from dask.distributed import wait

    pending, seen, address = set(futures), time.monotonic(), client.scheduler.address
    while pending:
        done: Collection[Future] = ()
        try:
            with contextlib.suppress(TimeoutError):
                done, pending = wait(pending, LOOK, "FIRST_COMPLETED")
            if done or client.nthreads():
                seen = time.monotonic()
        except (CancelledError, OSError) as error:
            raise RuntimeError(f"the Dask scheduler {address} was lost: start it and its workers again") from error
        if time.monotonic() - seen > PATIENCE:
            seen = float("inf")  # said once, until there is a worker again
            tqdm.write(f"the Dask scheduler {address} has no workers, and nothing is done until one joins: "
                       f"`dask worker {address}` starts one", file=sys.stderr)  # fmt: skip
        yield from done
