"""Several processes that train together, on one host or many: each runs the same program on its own devices."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxdrones.checks import check_whole

_PATIENCE = 60.0  # s that hosts wait for each other at the start
_PARTING = 10  # s that one waits for the others at the end; if it broke off, JAX then ends them too
_PAUSE = 0.1  # s between two calls


@contextlib.contextmanager
def together(hosts: int, host: int, coordinator: str, patience: float = _PATIENCE) -> Iterator[None]:
    """Make this process one of several; to be entered before anything else is done with JAX.

    Args:
        hosts: number of processes.
        host: which of them this is, from 0.
        coordinator: address of host 0, and a port that is free there, such as 127.0.0.1:9911.
        patience: s to wait for the others.

    Raises:
        ValueError: an argument is wrong, or the others did not come.
    """
    check_whole("hosts", hosts)
    if not 0 <= host < hosts:
        raise ValueError(f"host is {host}; give 0 to {hosts - 1}, another one to each of the {hosts} hosts")
    name, _, port = coordinator.rpartition(":")
    if not (name and port.isdecimal() and 0 < int(port) < 2**16):
        raise ValueError(f"coordinator is {coordinator!r}; give ADDRESS:PORT of host 0, for example 127.0.0.1:9911")
    deadline = time.monotonic() + patience
    try:  # before JAX does, which ends the process if it waits in vain
        _await_calls((name, int(port)), hosts, deadline) if host == 0 else _call((name, int(port)), host, deadline)
    except (OSError, TypeError, UnicodeError) as error:  # the last two of a name that can be none
        raise ValueError(
            f"host {host} of {hosts} did not meet all others at {coordinator} within {patience:g} s ({error}); start "
            f"the same command with --host 0 to --host {hosts - 1}, with the --coordinator that host 0 can listen at"
        ) from None
    jax.distributed.initialize(
        coordinator,
        hosts,
        host,
        coordinator_bind_address=coordinator,
        cluster_detection_method="deactivate",
        shutdown_timeout_seconds=_PARTING,
    )
    try:
        with _stdout_as_stderr():  # Gloo, which CPUs talk through, greets
            meet("start")
        yield
    finally:
        jax.distributed.shutdown()


def meet(place: str) -> None:
    """Wait until every host is here."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(place)


@contextlib.contextmanager
def checked() -> Iterator[None]:
    """A mistake that one host finds in here stops all of them, before they wait for each other in vain."""
    wrong = None
    try:
        yield
    except Exception as error:
        wrong = error
    if jax.process_count() > 1:
        stopped = np.flatnonzero(multihost_utils.process_allgather(np.asarray(wrong is not None)))
        if wrong is None and len(stopped):
            raise ValueError(f"host {stopped[0]} stopped; see there why")
    if wrong is not None:
        raise wrong


def agreed(number: float) -> float:
    """The first host's number, on every host: of clocks, which differ, when something is decided by them."""
    if jax.process_count() == 1:
        return number
    return float(multihost_utils.broadcast_one_to_all(np.float32(number)))


@contextlib.contextmanager
def _stdout_as_stderr() -> Iterator[None]:
    """For what libraries print that are not Python's."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)


def _await_calls(address: tuple[str, int], hosts: int, deadline: float) -> None:
    """Host 0 listens until all others have called, then answers them."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_server(address))
        calls: dict[str, socket.socket] = {}
        while len(calls) < hosts - 1:
            server.settimeout(max(deadline - time.monotonic(), _PAUSE))
            call = stack.enter_context(server.accept()[0])
            call.settimeout(_PAUSE)
            with contextlib.suppress(TimeoutError):
                caller = call.recv(16).decode(errors="replace")
                if caller in map(str, range(1, hosts)):
                    calls[caller] = call
        server.close()
        for call in calls.values():
            call.sendall(b"come")


def _call(address: tuple[str, int], host: int, deadline: float) -> None:
    """The others call host 0 until it answers."""
    while True:
        left = max(deadline - time.monotonic(), _PAUSE)
        try:
            with socket.create_connection(address, timeout=left) as call:
                call.sendall(str(host).encode())
                if call.recv(16) != b"come":
                    raise ConnectionError("host 0 hung up")
                return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_PAUSE)
