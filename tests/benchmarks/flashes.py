"""``python -m tests.benchmarks.flashes [PLANS]``: how often domes flash in random plans with preflight and light by
hand, and how long a capture of 54 lights takes at several rates. The clock is injected, the driver is the real one.
"""

from __future__ import annotations

import random
import sys
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

from services.capture.dome.flashes import Flashes
from services.core.light.safety import FlashAcknowledgement
from services.core.records import RigSpec
from tests.support.flashing_plans import captured, flashes_of_random_work
from tests.support.model_dome import Clock, Controller, most_in_a_second, random_delays

RATES = (3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0)
EXPOSURE_S = 0.05
TRANSACTION_S = 0.004
"""Longest time of a transaction with the controller: twice what it takes over loopback."""


def main(plans: int) -> None:
    """Print the numbers of flashes in any second, and the times of 54 lights."""
    worst: Counter[int] = Counter()
    flashes = 0
    for seed in range(plans):
        times_s = flashes_of_random_work(seed)
        worst[most_in_a_second(times_s)] += 1
        flashes += len(times_s)
    print(f"{plans} plans, {flashes} flashes; most flashes in any second: plans {dict(sorted(worst.items()))}")
    assert max(worst) <= 3
    rig = RigSpec(mouth=Path("mouth"), exposure_s=EXPOSURE_S)
    for per_s in RATES:
        clock, source = Clock(), random.Random(1)
        controller = Controller(54, clock, random_delays(source, TRANSACTION_S / 2))
        stated = (
            FlashAcknowledgement(per_s=per_s, eye_cover=True, epilepsy_asked=True, by="benchmark", at=datetime.now(UTC))
            if per_s > RATES[0]
            else None
        )
        captured(controller, rig, Flashes(stated, clock=clock))
        at_s = controller.flashes_s
        print(
            f"{per_s:4.0f} a second: preflight {at_s[54] - at_s[0]:5.1f} s, capture {clock() - at_s[55]:5.1f} s, both"
            f" {clock():5.1f} s; most in any second {most_in_a_second(at_s)}"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
