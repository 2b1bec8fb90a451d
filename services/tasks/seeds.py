"""Counter-based seeds: a pass's random numbers depend on its purpose alone, never on where or when it runs."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass


@dataclass(frozen=True)
class Seeds:
    """Seeds of one channel of one job."""

    job_seed: int
    channel: str

    def __call__(self, *purpose: str | int) -> int:
        """Seed below 2^31 of a pass such as ``seeds("layered", step, "image")``; the engine adds pixel and sample to
        it.
        """
        text = "/".join(str(part) for part in (self.job_seed, self.channel, *purpose))
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big") >> 1
