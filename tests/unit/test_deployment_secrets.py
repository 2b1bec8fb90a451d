"""The secrets that the parts of a composed system share: made once, renewed in time, and readable only to those who
need them.
"""

from __future__ import annotations

import os
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509

from services.api.deployment import secrets as deployment_secrets
from services.api.deployment.secrets import make_missing
from services.core.errors import SettingsError
from services.pipeline.dask_tls import Certificates


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_what_is_there_stays(tmp_path: Path) -> None:
    assert make_missing(tmp_path) == ["authority", "certificate", "database password"]
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert make_missing(tmp_path) == []
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_the_certificate_is_good_for_both_sides_of_a_connection(tmp_path: Path) -> None:
    make_missing(tmp_path)
    certificates = Certificates.of(tmp_path / "tls")
    authority = x509.load_pem_x509_certificate(certificates.authority.read_bytes())
    part = x509.load_pem_x509_certificate(certificates.certificate.read_bytes())
    part.verify_directly_issued_by(authority)
    assert datetime.now(UTC) + timedelta(days=300) < part.not_valid_after_utc < authority.not_valid_after_utc


def test_keys_are_their_owners_alone(tmp_path: Path) -> None:
    make_missing(tmp_path)
    assert {mode(tmp_path / "authority" / "ca.key"), mode(tmp_path / "tls" / "tls.key")} == {0o600}
    assert not (tmp_path / "tls" / "ca.key").exists()


def test_a_certificate_is_renewed_before_it_ends_by_the_same_authority(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as short:
        short.setattr(deployment_secrets, "CERTIFICATE_LIFE", deployment_secrets.RENEW_BEFORE - timedelta(days=1))
        make_missing(tmp_path)
    authority = (tmp_path / "authority" / "ca.crt").read_bytes()
    assert make_missing(tmp_path) == ["certificate"]
    assert make_missing(tmp_path) == []
    assert make_missing(tmp_path, renew=True) == ["certificate"]
    assert (tmp_path / "authority" / "ca.crt").read_bytes() == authority
    Certificates.of(tmp_path / "tls")


@pytest.mark.parametrize(
    ("path", "reason"),
    [("authority/ca.key", "no plain elliptic-curve key"), ("authority/ca.crt", "no PEM certificate")],
)
def test_a_damaged_file_is_named_and_nothing_is_made(tmp_path: Path, path: str, reason: str) -> None:
    make_missing(tmp_path)
    (tmp_path / path).chmod(0o600)
    (tmp_path / path).write_text("damaged\n")
    before = (tmp_path / "tls" / "tls.crt").read_bytes()
    with pytest.raises(SettingsError, match=reason) as told:
        make_missing(tmp_path, renew=True)
    assert str(tmp_path / path) in told.value.message
    assert (tmp_path / "tls" / "tls.crt").read_bytes() == before


@pytest.mark.skipif(os.geteuid() != 0, reason="only the superuser reads what nobody else may")
def test_the_password_is_read_by_the_database_of_another_user(tmp_path: Path) -> None:
    make_missing(tmp_path)
    assert mode(tmp_path / "database" / "password") == 0o444
    assert len((tmp_path / "database" / "password").read_text().strip()) >= 32
