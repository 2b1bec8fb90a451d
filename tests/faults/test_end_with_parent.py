"""A process that runs beside a worker ends when the worker is killed."""

from __future__ import annotations

import subprocess
import sys

import psutil

PARENT = """
import subprocess, sys
from services.phantom.end_with_parent import command
child = subprocess.Popen(command("tests.support.sleeper", ["60"]), stdin=subprocess.PIPE)
print(child.pid, flush=True)
child.wait()
"""
PATIENCE_S = 20.0
"""Longest time that a busy machine may take to end a process, seconds; usually some milliseconds."""


def test_a_killed_parent_leaves_no_child() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        # The child itself says that it sleeps, so it is alive and its watch has begun.
        assert parent.stdout.readline() == "sleeping for 60 s\n"
        parent.kill()
        psutil.wait_procs([child], timeout=PATIENCE_S)
        assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


def test_the_module_gets_its_arguments_and_its_exit_status_counts() -> None:
    command = [sys.executable, "-m", "services.phantom.end_with_parent", "tests.support.sleeper", "0"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.read() == "sleeping for 0 s\n"
        assert child.wait() == 3
