"""Python's cyclic garbage collector in a server that must answer meanwhile."""

from __future__ import annotations

import gc


def leave_alone_what_is_loaded() -> None:
    """Never again walk through the modules that were imported: with Dask's that takes 0.15 s, in which nobody is
    answered.
    """
    gc.collect()
    gc.freeze()
