"""The secrets that the parts of one system share: a certificate authority, the certificate that it has issued for all
parts, and the password of the database.

::

    FOLDER/authority/ca.key, ca.crt             signs; only whoever makes certificates needs it
    FOLDER/tls/ca.crt, tls.crt, tls.key         what API, scheduler and workers show each other, see ``dask_tls``
    FOLDER/database/password                    read by the database, the API and the workers

Each of the three folders can be a volume of its own, so that every part is given what it needs and no more.
"""

from __future__ import annotations

import secrets
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from services.core.errors import SettingsError
from services.core.files.private import write_private

AUTHORITY_LIFE = timedelta(days=3650)
CERTIFICATE_LIFE = timedelta(days=365)
RENEW_BEFORE = timedelta(days=60)
"""Remaining life of a certificate below which it is made anew when the system starts: a system that is restarted twice
a quarter never meets its end."""
CLOCK_STEP = timedelta(minutes=5)
"""Largest difference between the clocks of hosts at which a new certificate is valid on all of them."""
PASSWORD_BYTES = 24
"""Number of random bytes in a password of the database."""
READABLE_BY_ALL = 0o444
"""File mode of the password's file and of certificates: the database runs as another user than the parts that ask it.
The folder keeps others out."""


def make_missing(folder: Path, *, renew: bool = False) -> list[str]:
    """Make the secrets that are absent or end soon; ``renew`` makes the certificate of the parts anew in any case.

    Returns:
        Names of the secrets that were made.

    Raises:
        SettingsError: a file that is there is no certificate or key of the kind that this program makes.
    """
    authority, tls, database = (folder / name for name in ("authority", "tls", "database"))
    for one in (authority, tls, database):
        one.mkdir(parents=True, exist_ok=True)
    made = []
    if not (authority / "ca.key").exists() or _ends_soon(authority / "ca.crt"):
        _make_authority(authority)
        made.append("authority")
    if renew or made or _ends_soon(tls / "tls.crt"):
        _make_certificate(authority, tls)
        made.append("certificate")
    if not (database / "password").exists():
        write_password(database / "password", secrets.token_urlsafe(PASSWORD_BYTES))
        made.append("database password")
    return made


def write_password(path: Path, password: str) -> None:
    """Write the password of the database to the file from which its users read it."""
    write_private(path, f"{password}\n".encode(), READABLE_BY_ALL)


def _ends_soon(path: Path) -> bool:
    if not path.exists():
        return True
    return _certificate(path).not_valid_after_utc < datetime.now(UTC) + RENEW_BEFORE


def _certificate(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as problem:
        raise SettingsError(
            f"{path} is no PEM certificate; restore it, or remove it and what it signed so that both are made anew."
        ) from problem


def _signing_key(path: Path) -> ec.EllipticCurvePrivateKey:
    with suppress(ValueError, TypeError):  # TypeError: the key needs a passphrase
        key = serialization.load_pem_private_key(path.read_bytes(), None)
        if isinstance(key, ec.EllipticCurvePrivateKey):
            return key
    raise SettingsError(
        f"{path} is no plain elliptic-curve key in PEM; restore it, or remove the folder so that another authority is"
        " made."
    )


def _make_authority(folder: Path) -> None:
    key, name = ec.generate_private_key(ec.SECP256R1()), _name("dentine authority")
    usage = x509.KeyUsage(
        digital_signature=False,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=True,
        encipher_only=False,
        decipher_only=False,
    )
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    builder = _builder(name, name, key, AUTHORITY_LIFE).add_extension(
        x509.BasicConstraints(ca=True, path_length=0), critical=True
    )
    builder = builder.add_extension(usage, critical=True).add_extension(identifier, critical=False)
    _write_key(folder / "ca.key", key)
    write_private(folder / "ca.crt", _pem(builder.sign(key, hashes.SHA256())), READABLE_BY_ALL)


def _make_certificate(authority: Path, folder: Path) -> None:
    signer, issuer = _signing_key(authority / "ca.key"), _certificate(authority / "ca.crt")
    key = ec.generate_private_key(ec.SECP256R1())
    identifier = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key())
    builder = _builder(_name("dentine part"), issuer.subject, key, CERTIFICATE_LIFE)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    builder = builder.add_extension(identifier, critical=False)
    # Write the key first: a reader of both in between finds that they do not belong together, and tries again.
    _write_key(folder / "tls.key", key)
    write_private(folder / "tls.crt", _pem(builder.sign(signer, hashes.SHA256())), READABLE_BY_ALL)
    write_private(folder / "ca.crt", _pem(issuer), READABLE_BY_ALL)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, life: timedelta
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
    return (
        builder.serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_STEP)
        .not_valid_after(now + life)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    pkcs8, unencrypted = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    write_private(path, key.private_bytes(serialization.Encoding.PEM, pkcs8, unencrypted))
