"""Training in several processes, called hosts, each with the same program on its own devices."""

import contextlib
import os
import socket
import sys
import time
from collections.abc import Iterator

import jax
import numpy as np
from jax.experimental import multihost_utils

from jaxdrones.arguments import Count, Seconds, checked
from jaxdrones.errors import UserError

_TIMEOUT = 60.0  # s; timeout of the connection at the start
_SHUTDOWN_TIMEOUT = 10  # s; timeout at the end, after which JAX ends the other hosts
_PAUSE = 0.1  # s between two attempts to connect
_READY = b"ready"  # answer of host 0


@checked
@contextlib.contextmanager
def join_hosts(hosts: Count, host: int, coordinator: str, timeout: Seconds = _TIMEOUT) -> Iterator[None]:
    """Context of one of several hosts, counted from 0; enter it before any other use of JAX.

    `coordinator` is the address and a free port of host 0, such as 127.0.0.1:9911; `timeout` is the time to wait for
    the others, s.
    """
    if not 0 <= host < hosts:
        raise UserError(f"host is {host}; give 0 to {hosts - 1}, a different number on each of the {hosts} hosts")
    name, _, port = coordinator.rpartition(":")
    if not (name and port.isdecimal() and 0 < int(port) < 2**16):
        raise UserError(f"coordinator is {coordinator!r}; give ADDRESS:PORT of host 0, for example 127.0.0.1:9911")
    deadline, address = time.monotonic() + timeout, (name, int(port))
    try:  # before JAX connects, as its timeout ends the process
        _accept_hosts(address, hosts, deadline) if host == 0 else _connect(address, host, deadline)
    except (OSError, TypeError, UnicodeError) as error:  # the last two come from an impossible name
        raise UserError(
            f"host {host} of {hosts} did not reach all others at {coordinator} within {timeout:g} s ({error}); start "
            f"the same command with --host 0 to --host {hosts - 1}, and with a --coordinator at which host 0 can listen"
        ) from None
    jax.distributed.initialize(
        coordinator,
        hosts,
        host,
        coordinator_bind_address=coordinator,
        cluster_detection_method="deactivate",
        shutdown_timeout_seconds=_SHUTDOWN_TIMEOUT,
    )
    try:
        with _stdout_to_stderr():  # Gloo, the communication library of CPUs, prints on connection
            wait_for_hosts("start")
        yield
    finally:
        jax.distributed.shutdown()


def wait_for_hosts(barrier: str) -> None:
    """Wait until every host has reached the barrier of this name."""
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(barrier)


@contextlib.contextmanager
def fail_together() -> Iterator[None]:
    """Context that stops all hosts if one of them raises."""
    raised = None
    try:
        yield
    except Exception as error:
        raised = error
    if jax.process_count() > 1:
        stopped = np.flatnonzero(multihost_utils.process_allgather(np.asarray(raised is not None)))
        if raised is None and len(stopped):
            raise UserError(f"host {stopped[0]} stopped; its message says why")
    if raised is not None:
        raise raised


def from_first_host(number: float) -> float:
    """Value of the first host, on every host, for common decisions."""
    if jax.process_count() == 1:
        return number
    return float(multihost_utils.broadcast_one_to_all(np.float32(number)))


@contextlib.contextmanager
def _stdout_to_stderr() -> Iterator[None]:
    """Redirect standard output to standard error, also of native libraries."""
    sys.stdout.flush()
    original = os.dup(1)
    os.dup2(2, 1)
    try:
        yield
    finally:
        os.dup2(original, 1)
        os.close(original)


def _accept_hosts(address: tuple[str, int], hosts: int, deadline: float) -> None:
    """On host 0: wait for all other hosts, then answer them."""
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(socket.create_server(address))
        connections: dict[str, socket.socket] = {}
        while len(connections) < hosts - 1:
            server.settimeout(max(deadline - time.monotonic(), _PAUSE))
            connection = stack.enter_context(server.accept()[0])
            connection.settimeout(_PAUSE)
            with contextlib.suppress(TimeoutError):
                host = connection.recv(16).decode(errors="replace")
                if host in map(str, range(1, hosts)):
                    connections[host] = connection
        server.close()
        for connection in connections.values():
            connection.sendall(_READY)


def _connect(address: tuple[str, int], host: int, deadline: float) -> None:
    """On the other hosts: connect to host 0 and wait for its answer."""
    while True:
        remaining = max(deadline - time.monotonic(), _PAUSE)
        try:
            with socket.create_connection(address, timeout=remaining) as connection:
                connection.sendall(str(host).encode())
                if connection.recv(16) != _READY:
                    raise ConnectionError("host 0 closed the connection")
                return
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(_PAUSE)
