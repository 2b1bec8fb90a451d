"""Log lines that carry the request and the job they belong to: JSON where a program reads them, plain text in a
terminal.

Code logs through ``logging`` with ``extra``; the values of ``log_context`` around it are added here. Only the owner of
a process configures its logs: ``serve``, and each worker of a server's job.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from services.core.errors import DentineError
from services.core.stage import StageEvent, StageName

if TYPE_CHECKING:
    from services.pipeline.event_log import EventAddress
    from services.pipeline.log_stream import QueuedStream


def configure_logs(stream: TextIO | QueuedStream) -> None:
    """Write every log line of this process to a stream, as JSON unless it is a terminal.

    Other packages log only warnings and errors.
    """
    import structlog

    shared: list[Any] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.stdlib.ExtraAdder(),
        structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),
    ]
    if stream.isatty():
        shown: list[Any] = [
            structlog.dev.ConsoleRenderer(timestamp_key="time", exception_formatter=structlog.dev.plain_traceback)
        ]
    else:
        shown = [
            structlog.processors.format_exc_info,
            structlog.processors.EventRenamer("message"),
            structlog.processors.JSONRenderer(),
        ]
    formatter = structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=shared, processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *shown]
    )
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(logging.WARNING)
    logging.getLogger("services").setLevel(logging.INFO)


def log_context(**values: str | int | None) -> AbstractContextManager[None]:
    """Add values to every line logged inside the block; values that are None are left out."""
    from structlog.contextvars import bound_contextvars

    return bound_contextvars(**{name: value for name, value in values.items() if value is not None})


def bind_request(request_id: str) -> None:
    """Add the id of a request to every line logged from here on in the server's task for the request."""
    from structlog.contextvars import bind_contextvars

    bind_contextvars(request_id=request_id)


@contextmanager
def stage_logs(stage: StageName, attempt: int, address: EventAddress) -> Iterator[Callable[[StageEvent], None]]:
    """Log a stage in its worker's process: its start, its end, and those events of kind log that the yielded listener
    is given.
    """
    configure_logs(sys.stderr)
    log = logging.getLogger(__name__)

    def log_event(event: StageEvent) -> None:
        if event.kind == "log":
            log.info(event.message)

    with log_context(request_id=address.request_id, job=address.job, stage=stage, attempt=attempt):
        log.info("Stage started.")
        try:
            yield log_event
        except DentineError as problem:
            log.warning("Stage stopped: %s", problem.message, extra={"code": problem.code})
            raise
        except Exception:
            log.exception("Stage broke.")
            raise
        log.info("Stage finished.")
