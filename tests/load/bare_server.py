"""``python -m tests.load.bare_server DATABASE``: FastAPI with one route that reads one row of SQLite; prints its
address.
"""

from __future__ import annotations

import socket
import sqlite3
import sys
import threading
from typing import Any

import uvicorn
from fastapi import FastAPI


def build(database: str) -> FastAPI:
    """The application; every thread has its connection."""
    app, local = FastAPI(), threading.local()

    @app.get("/jobs/{job_id}")
    def read(job_id: str) -> dict[str, Any]:
        if not hasattr(local, "connection"):
            local.connection = sqlite3.connect(database)
        row = local.connection.execute(
            "SELECT id, number, state, created_s, changed_s FROM job WHERE id = ?", (job_id,)
        ).fetchone()
        return dict(zip(("id", "number", "state", "created_s", "changed_s"), row, strict=True))

    return app


def main(database: str) -> None:
    """Serve as ``services.api.server`` does: one worker, the same loop and HTTP implementation, no access log."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP) as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        print(f"http://127.0.0.1:{listener.getsockname()[1]}", flush=True)
        config = uvicorn.Config(
            build(database), log_config=None, log_level="warning", access_log=False, timeout_graceful_shutdown=1
        )
        uvicorn.Server(config).run(sockets=[listener])


if __name__ == "__main__":
    main(sys.argv[1])
