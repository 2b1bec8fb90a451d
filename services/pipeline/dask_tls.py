"""Mutual TLS between the parts of Dask, by one folder of certificates that the API, the scheduler and every worker
have.
"""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.errors import SettingsError

if TYPE_CHECKING:
    from distributed import Security


@dataclass(frozen=True)
class Certificates:
    """Paths of an authority's certificate, of a certificate that this authority has signed, and of the latter's key.

    A peer is accepted if its certificate is one of the authority, and no other peer is, so the authority must sign for
    this system alone. Host names are not compared.
    """

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, folder: Path) -> Certificates:
        """The files of a folder, named as Kubernetes names them: ``ca.crt``, ``tls.crt``, ``tls.key``.

        Raises:
            SettingsError: one of the files is absent, or they do not belong together.
        """
        found = cls(folder / "ca.crt", folder / "tls.crt", folder / "tls.key")
        for path in (found.authority, found.certificate, found.key):
            if not path.is_file():
                raise SettingsError(
                    f"Setting DENTINE__SERVER__TLS: {path} does not exist; the folder needs ca.crt, tls.crt and"
                    " tls.key."
                )
        try:
            found.context()
        except OSError as problem:
            what = f"Setting DENTINE__SERVER__TLS: the certificates in {folder} cannot be used ({problem})"
            raise SettingsError(
                f"{what}; tls.key must be the key of tls.crt and readable, and all must be PEM."
            ) from problem
        return found

    def context(self) -> ssl.SSLContext:
        """The TLS context for a connection to the scheduler."""
        context = ssl.create_default_context(cafile=self.authority)
        context.check_hostname = False
        # Dask itself does the same: from Python 3.13 on the default refuses the certificate of an authority without the
        # extension for key usage, and many are made without it.
        context.verify_flags &= ~ssl.VERIFY_X509_STRICT
        context.load_cert_chain(self.certificate, self.key)
        return context

    def security(self) -> Security:
        """The TLS settings for Dask's own client."""
        from services.pipeline.dask_security import LastingSecurity

        files = {
            f"tls_{role}_{part}": str(path)
            for role in ("client", "scheduler", "worker")
            for part, path in (("cert", self.certificate), ("key", self.key))
        }
        return LastingSecurity(tls_ca_file=str(self.authority), require_encryption=True, **files)

    def arguments(self) -> tuple[str, ...]:
        """The TLS options for Dask's commands."""
        return (
            *("--protocol", "tls", "--tls-ca-file", str(self.authority)),
            *("--tls-cert", str(self.certificate), "--tls-key", str(self.key)),
        )


def scheduler_address(address: str, certificates: Certificates | None) -> str:
    """An address as Dask expects it; the certificates decide about TLS, whatever the address says."""
    return address.replace("tcp://", "tls://", 1) if certificates is not None else address
