"""A Dask cluster that does not work is told about in time, whatever it lacks."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from dask.distributed import Client, LocalCluster

from mmgsd import cluster
from mmgsd.cluster import open_client, open_threads, unchanged_environment, wait_for_each


@pytest.fixture
def theirs() -> Iterator[LocalCluster]:
    """A scheduler without workers, in this process, at an address of TCP."""
    how = {"protocol": "tcp", "host": "127.0.0.1", "dashboard_address": None, "silence_logs": "CRITICAL"}
    with unchanged_environment(), LocalCluster(n_workers=0, processes=False, **how) as made:
        yield made


def submit(client: Client, count: int = 2) -> list:
    return [client.submit(str, number, pure=False) for number in range(count)]


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH_9.2p1\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"", None])
def test_a_port_that_is_not_dasks_is_named_in_time(monkeypatch: pytest.MonkeyPatch, greeting: bytes | None) -> None:
    monkeypatch.setattr(cluster, "ANSWER", 1.0)
    with socket.create_server(("127.0.0.1", 0)) as server:
        address, asked = f"tcp://127.0.0.1:{server.getsockname()[1]}", []

        def answer() -> None:
            """Greets the first that connects, or nobody."""
            asked.append(server.accept()[0])
            asked[0].sendall(greeting)

        threading.Thread(target=answer, daemon=True).start() if greeting is not None else server.close()
        with pytest.raises(ValueError, match=f"^scheduler must be .*{address}"):
            open_client(address)


def test_a_scheduler_without_workers_says_so_once_and_goes_on_when_one_joins(
    theirs: LocalCluster, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(cluster, "PATIENCE", 0.3)
    monkeypatch.setattr(cluster, "LOOK", 0.1)
    for _ in range(2):  # at first, and after the last one was lost
        monkeypatch.setattr(cluster, "tqdm", Joining(theirs))
        with open_client(theirs.scheduler_address) as client:
            assert sorted(future.result() for future in wait_for_each(client, submit(client))) == ["0", "1"]
        assert len(cluster.tqdm.said) == 1 and f"dask worker {theirs.scheduler_address}" in cluster.tqdm.said[0]
        theirs.scale(0)
        while theirs.workers or theirs.scheduler.workers:
            time.sleep(0.05)


class Joining:
    """In place of tqdm: a worker joins as soon as something is said."""

    def __init__(self, theirs: LocalCluster) -> None:
        self.theirs, self.said = theirs, []

    def write(self, line: str, *, file: object) -> None:
        self.said.append(line)
        self.theirs.scale(1)


def test_a_lost_scheduler_is_named(theirs: LocalCluster, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster, "LOOK", 0.1)
    with open_client(theirs.scheduler_address) as client:
        address, waiting = theirs.scheduler_address, wait_for_each(client, submit(client))
        threading.Timer(0.5, theirs.close).start()
        with pytest.raises(RuntimeError, match=f"{address} was lost"):
            list(waiting)


@pytest.mark.parametrize(("cores", "quota", "expected"), [(64, (400000, 100000), 4), (2, (None, None), 2)])
def test_as_many_threads_as_cores_that_may_be_used(
    monkeypatch: pytest.MonkeyPatch, cores: int, quota: tuple, expected: int
) -> None:
    import dask.system

    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(cores)))
    monkeypatch.setattr(dask.system.psutil.Process, "cpu_affinity", lambda self: list(range(cores)))
    monkeypatch.setattr(dask.system, "_try_extract_cgroup_cpu_quota", lambda: quota)
    with open_threads() as client:
        assert sum(client.nthreads().values()) == expected


def test_a_machine_that_slept_loses_no_worker() -> None:
    with open_threads(1) as client:
        scheduler = client.cluster.scheduler
        for worker in scheduler.workers.values():
            worker.last_seen -= 24 * 3600  # s
        if check := scheduler.periodic_callbacks.get("worker-ttl"):
            client.sync(check.callback)
        assert client.submit(str, 1).result(timeout=5) == "1"
