"""The process that works the dome for this server; ``services.capture.console`` by name, as it is not installed with every server."""

from __future__ import annotations

import importlib.util
import itertools
import subprocess
import sys
import threading
from concurrent.futures import Future
from contextlib import suppress
from typing import Any

from services.core.dome import DomeAnswer, DomeCommand
from services.core.errors import DentineError, PlatformError, RigError, error_of
from services.core.settings import DomeSettings

DOOR = "services.capture.console"
END_S = 10.0


class DomeProcess:
    """Started when it is first needed and again after it died. It ends dark with the pipe to it, however this process ends."""

    def __init__(self, settings: DomeSettings) -> None:
        self._settings, self._lock, self._numbers = settings, threading.Lock(), itertools.count(1)
        self._process: subprocess.Popen[str] | None = None
        self._waiting: dict[int, Future[DomeAnswer]] = {}

    @property
    def is_running(self) -> bool:
        """Whether there is one; what is not running holds no light."""
        return self._process is not None and self._process.poll() is None

    def ask(self, timeout_s: float, **command: Any) -> DomeAnswer:
        """Have a command carried out, beside whatever else is being carried out.

        Raises:
            DentineError: what the command ended in. TimeoutError: no answer in time. PlatformError: the packages of the dome are not installed.
        """
        number = next(self._numbers)
        line = DomeCommand.model_validate({"number": number} | command).model_dump_json()
        future: Future[DomeAnswer] = Future()
        with self._lock:
            self._start()
            waiting = self._waiting
            waiting[number] = future
            assert self._process is not None
            assert self._process.stdin is not None
            try:
                print(line, file=self._process.stdin, flush=True)
            except BrokenPipeError:
                raise _ended() from None
        try:
            answer = future.result(timeout_s)
        finally:
            waiting.pop(number, None)
        if answer.code is not None:
            raise error_of(answer.code, answer.message) or DentineError(answer.message)
        return answer

    def start(self) -> None:
        """Start it if it is not running, so that nobody waits for that later.

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
        """Have it end dark."""
        with self._lock:
            self._end(END_S)

    def _end(self, patience_s: float) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None
        if not patience_s:
            process.kill()
        with suppress(BrokenPipeError):
            process.stdin.close()
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
        command = [sys.executable, "-m", DOOR, self._settings.model_dump_json()]
        # A session of its own: Ctrl-C must not reach it before the server has closed its pipe.
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True)  # noqa: S603
        self._waiting = {}
        threading.Thread(target=_listen, args=(self._process, self._waiting), name="dome process", daemon=True).start()


def _listen(process: subprocess.Popen[str], waiting: dict[int, Future[DomeAnswer]]) -> None:
    assert process.stdout is not None
    with process.stdout:
        for line in process.stdout:
            answer = DomeAnswer.model_validate_json(line)
            if (future := waiting.pop(answer.number, None)) is not None:
                future.set_result(answer)
    for number in list(waiting):
        waiting.pop(number).set_exception(_ended())


def _ended() -> RigError:
    return RigError("The process that works the dome ended, and so did its light; ask again, the server's log says why it ended.")
