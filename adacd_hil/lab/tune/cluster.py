"""The computing side of a sweep: processes of this machine, or a Dask cluster, and the protection of its connections.

A Dask scheduler runs whatever is sent to it, as the user that started it. So a scheduler that a sweep starts for itself
takes only work with a certificate that was made for it; only this process and its workers hold that certificate. A
cluster is addressed by tls:// with certificates, as Dask names them. Dask checks who signed a certificate, not for
which host.
"""

import contextlib
import logging
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from adacd_hil.log.log_files import LogError
from adacd_hil.remedies import install_command
from adacd_hil.settings.schema import ConfigError

TLS = "tls://"
_TIMEOUT_S = 10


class TlsFiles(NamedTuple):
    """Files in PEM format; Dask's configuration, `distributed.comm.tls`, gives those that are None."""

    ca_file: Path | None = None
    cert: Path | None = None
    key: Path | None = None


NO_FILES = TlsFiles()


@contextlib.contextmanager
def connect(scheduler: str, workers: int, tls: TlsFiles = NO_FILES) -> Iterator[Any]:
    """Give a client: of the scheduler at an address, or, where that is empty, of so many processes of this machine.

    Raises ConfigError when the certificates can't be used, LogError when nobody answers.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise LogError(f"sweep needs pyarrow and dask: {install_command('sweep')}") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what happens to workers shows in the rows
    with contextlib.ExitStack() as stack:
        if scheduler:
            security = _security_of(scheduler, tls)
            try:
                client = stack.enter_context(
                    Client(scheduler, timeout=_TIMEOUT_S, set_as_default=False, security=security)
                )
            except (OSError, TimeoutError, ValueError) as error:
                raise LogError(f"no Dask scheduler at {scheduler}: {' '.join(str(error).split())}") from None
        else:
            security = _security_of_one_sweep()
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                    security=security,
                )
            )
            client = stack.enter_context(Client(cluster, set_as_default=False, security=security))
        yield client


def _security_of_one_sweep() -> Any:
    """Make certificates for the processes of one sweep, in memory."""
    from distributed.security import Security

    try:
        return Security.temporary()
    except ImportError:
        raise LogError(f"sweep needs cryptography: {install_command('sweep')}") from None


def _security_of(scheduler: str, tls: TlsFiles) -> Any:
    """Read the certificates for an address; None where it is not of TLS. Raises ConfigError."""
    from distributed.security import Security

    if not scheduler.startswith(TLS):
        if any(tls):
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
    """Name what doesn't come from Dask's configuration. Raises ConfigError."""
    if tls.key is not None and tls.cert is None:
        raise ConfigError("--tls-key needs --tls-cert, the certificate that it belongs to")
    given: dict[str, str | None] = {}
    if tls.ca_file is not None:
        given["tls_ca_file"] = str(tls.ca_file)
    if tls.cert is not None:  # with its own key, never with the configuration's
        given["tls_client_cert"] = str(tls.cert)
        given["tls_client_key"] = None if tls.key is None else str(tls.key)
    return given
