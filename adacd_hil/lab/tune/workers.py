"""The computing side of a sweep: processes of this machine, or a Dask cluster, behind one interface.

A Dask scheduler runs any code that a client sends to its port, as the user that started it. So a cluster is addressed
by tls:// with certificates, as Dask names them. Dask checks the signer of a certificate, not its host. The processes of
this machine have no port.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import ssl
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import forkserver
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from adacd_hil.clock import MonotonicClock
from adacd_hil.extras import install_command
from adacd_hil.log.log_files import LogError
from adacd_hil.settings.schema import ConfigError
from adacd_hil.terminal import handling

TLS = "tls://"
TIMEOUT_S = 10
_IN_FLIGHT = 4
"""Tasks per worker of a cluster, so that no worker waits for the client."""
_PATIENCE_S = 2.0
"""Time for a process to end after SIGTERM; it may be in compiled code."""


TlsFiles = Mapping[str, Path | None]
"""Files in PEM format by Dask's names; Dask's configuration, `distributed.comm.tls`, gives those that are None."""
NO_FILES: TlsFiles = dict.fromkeys(("tls_ca_file", "tls_client_cert", "tls_client_key"))


@contextlib.contextmanager
def connect(scheduler: str, count: int, tls: TlsFiles = NO_FILES, preload: tuple[str, ...] = ()) -> Iterator["Workers"]:
    """Yield the workers of a Dask scheduler at an address, or, if that is "", `count` processes of this machine.

    Processes are ended, and the connection closed, at the block's end. tls: certificate files for the scheduler, by
    Dask's names; None: Dask's own. preload: modules that the processes import before their first task. Raises
    ConfigError if the certificates can't be used, LogError if dask is missing or the scheduler doesn't answer.
    """
    if not scheduler:
        pool = ProcessWorkers(count, preload)
        try:
            yield pool
        finally:
            pool.end()
        return
    try:
        from distributed import Client
    except ImportError:
        raise LogError(f"--scheduler needs dask: {install_command('sweep')}") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the rows show the failures of workers
    security = _security_of(scheduler, tls)
    try:
        client = Client(scheduler, timeout=TIMEOUT_S, set_as_default=False, security=security)
    except (OSError, TimeoutError, ValueError) as error:
        raise LogError(f"no Dask scheduler at {scheduler}: {' '.join(str(error).split())}") from None
    with client:
        yield DaskWorkers(client)


class DaskWorkers:
    """The workers of a Dask scheduler, which gives the task of a worker that has died to another."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._executor = client.get_executor(pure=False)

    @property
    def room(self) -> int:
        """Number of tasks that may be with the workers at a time."""
        return _IN_FLIGHT * max(1, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def submit(self, work: Callable[..., Any], task: Any) -> "Future[Any]":
        """Send a task to a worker, which calls `work(task)`; return a future of the result, at once."""
        future: Future[Any] = self._executor.submit(work, task)
        return future

    def replace_dead(self) -> None:
        """Do nothing: the scheduler gives the tasks of dead workers to others."""


class ProcessWorkers:
    """Processes of this machine, at most `room`, for as many tasks. They ignore Ctrl-C, and end with this process."""

    def __init__(self, count: int, preload: tuple[str, ...]) -> None:
        self.room = count
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([__name__, *preload])
        self._others = set(multiprocessing.active_children())
        self._pool = self._open()

    def _open(self) -> ProcessPoolExecutor:
        with handling(signal.SIG_IGN, signal.SIGINT):  # as do the processes that it forks, from their first moment
            forkserver.ensure_running()
        return ProcessPoolExecutor(self.room, self._context, initializer=_begin)

    def submit(self, work: Callable[..., Any], task: Any) -> "Future[Any]":
        """Send a task to a process, which calls `work(task)`; return a future of the result, at once.

        The future, or this call, raises BrokenExecutor if a process has died; then call `replace_dead`.
        """
        return self._pool.submit(work, task)

    def replace_dead(self) -> None:
        """End all processes and start new ones. Call it after one has died; tasks that were with them are lost."""
        self.end()
        self._pool = self._open()

    def end(self) -> None:
        """End all processes, with or without a task, by force after `_PATIENCE_S`; cancel waiting tasks.

        Processes that this process has started otherwise by multiprocessing since the workers were opened are ended,
        too.
        """
        processes: set[BaseProcess] = set(multiprocessing.active_children()) - self._others
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        clock = MonotonicClock()
        latest_ns = clock.now_ns() + round(_PATIENCE_S * 1e9)
        for process in processes:
            process.join(max(0.0, (latest_ns - clock.now_ns()) * 1e-9))
            process.kill()
        self._pool.shutdown()


Workers = DaskWorkers | ProcessWorkers
"""Processes that compute, wherever they are. room: tasks that may be with them at a time."""


def _begin() -> None:
    """Prepare a new worker process: at SIGTERM, and when its parent ends, it exits and cleans up."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))


def _end_with_parent() -> None:
    """Wait until the parent process has ended; then end this one by SIGTERM, or by force after `_PATIENCE_S`."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
        threading.Event().wait(_PATIENCE_S)
        os._exit(1)


def _security_of(scheduler: str, tls: TlsFiles) -> Any:
    """Return Dask's security settings for a TLS address, with the certificates; None for another address.

    Raises ConfigError if certificates are missing or can't be used, or are given for another address.
    """
    from distributed.security import Security

    if not scheduler.startswith(TLS):
        if any(tls.values()):
            raise ConfigError(f"--tls-ca-file, --tls-cert and --tls-key are for {TLS} addresses, not {scheduler}")
        return None
    try:
        security = Security(require_encryption=True, **_given(tls))
    except (ImportError, ValueError) as error:
        raise ConfigError(f"TLS can't be used: {error}") from None
    used = {"CA file": security.tls_ca_file, "certificate": security.tls_client_cert, "key": security.tls_client_key}
    for name, option in (("CA file", "--tls-ca-file"), ("certificate", "--tls-cert")):
        if not used[name]:
            raise ConfigError(f"{scheduler} needs {option}, or Dask's configuration of distributed.comm.tls")
    try:
        security.get_connection_args("client")
    except (OSError, ValueError) as error:
        reason = error.reason if isinstance(error, ssl.SSLError) else getattr(error, "strerror", None) or error
        named = ", ".join(f"{name} {value}" for name, value in used.items() if value and "\n" not in value)
        raise ConfigError(f"TLS can't be used: {reason} ({named})") from None
    return security


def _given(tls: TlsFiles) -> dict[str, str | None]:
    """Return the given TLS files by Dask's names, to replace those of Dask's configuration.

    A certificate without a key replaces the key by None. Raises ConfigError for a key without a certificate.
    """
    if tls["tls_client_key"] is not None and tls["tls_client_cert"] is None:
        raise ConfigError("--tls-key needs --tls-cert, the certificate that it belongs to")
    given: dict[str, str | None] = {name: str(path) for name, path in tls.items() if path is not None}
    if tls["tls_client_cert"] is not None:
        given.setdefault("tls_client_key", None)  # with its own key, never with the configuration's
    return given
