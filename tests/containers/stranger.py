"""A script of an outsider beside the system: connects to every address given and prints each answer, as JSON."""

from __future__ import annotations

import http.client
import json
import socket
import ssl
import sys

PATIENCE_S = 3.0


def answer_of(host: str, port: int) -> str:
    """Kind of answer at an address: ``closed``, ``tls refuses``, ``tls lets in``, ``http STATUS`` or ``silent``."""
    try:
        with socket.create_connection((host, port), PATIENCE_S):
            pass
    except OSError:
        return "closed"
    if (tls := _tls(host, port)) is not None:
        return tls
    try:
        connection = http.client.HTTPConnection(host, port, timeout=PATIENCE_S)
        connection.request("GET", "/v1/jobs", headers={"Host": "127.0.0.1"})
        return f"http {connection.getresponse().status}"
    except (OSError, http.client.HTTPException):
        return "silent"


def _tls(host: str, port: int) -> str | None:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with socket.create_connection((host, port), PATIENCE_S) as plain, context.wrap_socket(plain) as secured:
            return "tls refuses" if not secured.recv(1) else "tls lets in"
    except ssl.SSLError as problem:
        return "tls refuses" if "CERTIFICATE_REQUIRED" in str(problem) or "HANDSHAKE_FAILURE" in str(problem) else None
    except OSError:
        return None


if __name__ == "__main__":
    print(json.dumps({f"{host}:{port}": answer_of(host, port) for host, port in json.loads(sys.argv[1])}))
