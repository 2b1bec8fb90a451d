"""Runs the process that drives the dome for this server.

It is started as ``services.capture.console``, by name, as that is not installed with every server.
"""

from __future__ import annotations

import importlib.util
import itertools
import queue
import subprocess
import sys
import threading
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from services.client.errors import error_of
from services.core.dome import DomeAnswer, DomeCommand
from services.core.errors import DentineError, PlatformError, RigError
from services.core.settings import DomeSettings

CONSOLE_MODULE = "services.capture.console"
EXIT_TIMEOUT_S = 10.0


class DomeProcess:
    """The process that drives the dome. It is started when it is first needed, and again after it has died.

    When the pipe to it closes, it switches the dome dark and ends, so that this happens however the server ends. A
    thread of its own writes to the pipe, because writing blocks while the process does not read: no other thread waits
    for that, and the lock stays free for ``kill``.
    """

    def __init__(self, settings: DomeSettings) -> None:
        self._settings, self._lock, self._numbers = settings, threading.Lock(), itertools.count(1)
        self._process: subprocess.Popen[str] | None = None
        self._commands: queue.SimpleQueue[DomeCommand | None] = queue.SimpleQueue()
        self._pending: dict[int, Future[DomeAnswer]] = {}

    @property
    def is_running(self) -> bool:
        """Whether the process runs; one that does not run holds no light."""
        return self._process is not None and self._process.poll() is None

    def ask(self, timeout_s: float, **command: Any) -> DomeAnswer:
        """Have a command carried out, in parallel with the commands under way.

        Raises:
            DentineError: the error that the command ended with. TimeoutError: there was no answer in time.
                PlatformError: the packages of the dome are not installed.
        """
        request = DomeCommand.model_validate({"number": next(self._numbers)} | command)
        future: Future[DomeAnswer] = Future()
        with self._lock:
            self._start()
            pending = self._pending
            pending[request.number] = future
            self._commands.put(request)
        try:
            answer = future.result(timeout_s)
        finally:
            pending.pop(request.number, None)
        if answer.code is not None:
            raise error_of(answer.code, answer.message) or DentineError(answer.message)
        return answer

    def start(self) -> None:
        """Start the process if it does not run, so that no later command waits for that.

        Raises:
            PlatformError: the packages of the dome are not installed.
        """
        with self._lock:
            self._start()

    def kill(self) -> None:
        """End a process that does not answer; the dome's watchdog darkens a light that it held."""
        with self._lock:
            self._end(0.0)

    def close(self) -> None:
        """Let the process switch the dome dark and end."""
        with self._lock:
            self._end(EXIT_TIMEOUT_S)

    def _end(self, patience_s: float) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        if not patience_s:
            process.kill()
        self._commands.put(None)
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)
        process.kill()
        process.wait()

    def _start(self) -> None:
        if self.is_running:
            return
        self._end(0.0)
        if importlib.util.find_spec("pymodbus") is None:
            raise PlatformError("The dome's packages are not installed on the server; install dentine[capture].")
        command = [sys.executable, "-m", CONSOLE_MODULE, self._settings.model_dump_json()]
        # The process has a session of its own, because Ctrl-C must not reach it before the server has closed its pipe.
        self._process = subprocess.Popen(  # noqa: S603
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self._commands, self._pending = queue.SimpleQueue(), {}
        threading.Thread(
            target=_write_commands,
            args=(self._process, self._commands, self._pending),
            name="to the dome process",
            daemon=True,
        ).start()
        threading.Thread(
            target=_read_answers, args=(self._process, self._pending), name="dome process", daemon=True
        ).start()


def _write_commands(
    process: subprocess.Popen[str],
    commands: queue.SimpleQueue[DomeCommand | None],
    pending: dict[int, Future[DomeAnswer]],
) -> None:
    """Write every command, then close the pipe, which makes the process end."""
    assert process.stdin is not None
    for command in iter(commands.get, None):
        try:
            print(command.model_dump_json(), file=process.stdin, flush=True)
        except BrokenPipeError:
            _fail_pending(pending, command.number)
    with suppress(BrokenPipeError):
        process.stdin.close()


def _read_answers(process: subprocess.Popen[str], pending: dict[int, Future[DomeAnswer]]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            answer = DomeAnswer.model_validate_json(line)
            if (future := pending.pop(answer.number, None)) is not None:
                future.set_result(answer)
    _fail_pending(pending, *pending)


def _fail_pending(pending: dict[int, Future[DomeAnswer]], *numbers: int) -> None:
    for number in numbers:
        if (future := pending.pop(number, None)) is not None:
            future.set_exception(
                RigError(
                    "The process that works the dome ended, and so did its light; ask again, the server's log says why"
                    " it ended."
                )
            )
