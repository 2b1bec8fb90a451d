"""A process that says for how many seconds it sleeps, sleeps, and exits with status 3."""

from __future__ import annotations

import sys
import time

if __name__ == "__main__":
    print(f"sleeping for {sys.argv[1]} s", flush=True)
    time.sleep(float(sys.argv[1]))
    sys.exit(3)
