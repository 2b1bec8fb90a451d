"""The command line in the test's own process, where a process of its own would only import the same packages again."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch

from services.cli.app import main


def dentine(*arguments: str, folder: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    """What one call of ``dentine`` prints and ends with. It ends as a process does: with an exit status, never by an
    error.

    Args:
        arguments: arguments of the command.
        folder: folder in which it runs; None for the present one.
        environment: variables that are added to the environment.
    """
    output, errors, mask = io.StringIO(), io.StringIO(), os.umask(0o022)
    os.umask(mask)
    command = ["dentine", *arguments]
    try:
        with (
            redirect_stdout(output),
            redirect_stderr(errors),
            patch.object(sys, "argv", command),
            patch.dict(os.environ, environment),
            chdir(folder or Path.cwd()),
        ):
            main()
    except SystemExit as ended:
        status = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    finally:
        os.umask(mask)
    return subprocess.CompletedProcess(command, status, output.getvalue(), errors.getvalue())
