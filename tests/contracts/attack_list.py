"""The attack list: runs every test that is marked ``attack(kind, what)``, and writes a table of the results.

python -m tests.contracts.attack_list --json attacks.json

The table goes into the JSON file and into the page beside the API's documentation. An attack is held off when all its
cases passed. The table says which attacks this machine cannot try, such as those that need root.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "services" / "api" / "ATTACKS.md"
MARK = re.compile(
    r'^@pytest\.mark\.attack\(\s*"(?P<kind>[^"]+)", "(?P<what>[^"]+)"\s*\)\n'
    r"(?:(?!def |@pytest\.mark\.attack).*\n)*def (?P<test>\w+)\(",
    re.MULTILINE,
)
"""Pattern of a mark, the decorators below it, each on one or several lines, and the test's name."""
TITLE = """# Attacks that are tried

`make attacks` runs these tests and writes this page; what each of them does stands in its source below `tests/`.
`make contracts` sends ten thousand generated requests besides, `python -m tests.benchmarks.fuzzed_load` 2,000 while
others read, and `make faults` kills every part at every point of a job. An attack is held off when the server refuses
it in the words of its description, does and stores nothing of it, and goes on serving others.
"""


@dataclass
class Attack:
    """One row of the table."""

    kind: str
    what: str
    test: str
    """The test's file and function."""
    outcomes: Counter[str] = field(default_factory=Counter)
    """Number of cases by outcome: passed, failed or skipped."""

    def row(self) -> dict[str, Any]:
        """The attack as JSON."""
        return {
            "kind": self.kind,
            "attack": self.what,
            "test": self.test,
            "outcome": self.outcome,
            "cases": dict(self.outcomes),
        }

    @property
    def outcome(self) -> str:
        """The result of the attack, in words."""
        if not self.outcomes or self.outcomes["failed"]:
            return "broke through" if self.outcomes["failed"] else "not run"
        return "held off" if not self.outcomes["skipped"] else f"held off, {self.outcomes['skipped']} not tried here"


def listed() -> list[Attack]:
    """Find every attack that the tests' sources mark, in their order."""
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        of = path.relative_to(ROOT)
        found += [
            Attack(match["kind"], match["what"], f"{of}::{match['test']}") for match in MARK.finditer(path.read_text())
        ]
    return found


class Collector:
    """A plugin of pytest that counts the cases of each attack."""

    def __init__(self, attacks: Iterable[Attack]) -> None:
        self._attacks = {attack.test: attack for attack in attacks}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count a case once: when its test function ran, or when its set-up or tear-down failed or skipped it."""
        attack = self._attacks.get(report.nodeid.partition("[")[0])
        if attack is not None and (report.when == "call" or report.outcome != "passed"):
            attack.outcomes[report.outcome] += 1


def table(attacks: Iterable[Attack]) -> str:
    """Text of the page: one table per kind of attack."""
    by_kind: dict[str, list[Attack]] = defaultdict(list)
    for attack in attacks:
        by_kind[attack.kind].append(attack)
    lines = [TITLE]
    for kind, rows in sorted(by_kind.items()):
        lines += [f"\n## {kind[0].upper()}{kind[1:]}\n\n| attack | cases | outcome | test |\n|---|---|---|---|\n"]
        lines += [
            f"| {row.what} | {row.outcomes.total()} | {row.outcome} | `{row.test.removeprefix('tests/')}` |\n"
            for row in rows
        ]
    return "".join(lines)


def main() -> None:
    """Run the attacks, write the page and the JSON file, and print those that were not held off."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--only", help="kind of attacks; without it all, and the page is written")
    arguments = parser.parse_args()
    attacks = [attack for attack in listed() if arguments.only in {None, attack.kind}]
    if not attacks:
        parser.error(
            f"there is no kind {arguments.only!r}; known are {', '.join(sorted({attack.kind for attack in listed()}))}"
        )
    status = pytest.main(
        [*(str(ROOT / attack.test) for attack in attacks), "-m", "attack"], plugins=[Collector(attacks)]
    )
    arguments.json.write_text(json.dumps([attack.row() for attack in attacks], indent=1) + "\n")
    if arguments.only is None:
        PAGE.write_text(table(attacks))
    broken = [attack for attack in attacks if not attack.outcome.startswith("held off")]
    for attack in broken:
        print(f"{attack.kind}: {attack.what}: {attack.outcome} ({attack.test})")
    print(
        f"{len(attacks)} attacks in {sum(attack.outcomes.total() for attack in attacks)} cases,"
        f" {len(attacks) - len(broken)} held off."
    )
    raise SystemExit(bool(broken) or status != 0)


if __name__ == "__main__":
    main()
