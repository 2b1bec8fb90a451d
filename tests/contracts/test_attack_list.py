"""The page of attacks names every attack that a test tries, and no other; see ``attack_list``."""

from __future__ import annotations

from collections import Counter

from tests.contracts.attack_list import PAGE, ROOT, listed

KINDS = (
    "traversal",
    "webhooks",
    "uploads",
    "routes × scopes",
    "cross-site",
    "tokens",
    "exhaustion",
    "Dask and files as another user",
    "light",
)


def test_every_attack_is_on_the_page() -> None:
    rows = [line.split(" | ") for line in PAGE.read_text().splitlines() if line.startswith("| ") and "::" in line]
    assert Counter((row[0].removeprefix("| "), row[3].strip("` |")) for row in rows) == Counter(
        (attack.what, attack.test.removeprefix("tests/")) for attack in listed()
    ), "attacks have changed: run make attacks"


def test_every_mark_is_read() -> None:
    marks = sum(path.read_text().count("@pytest.mark.attack(") for path in (ROOT / "tests").rglob("test_*.py"))
    assert len(listed()) == marks - 1  # the text in the line above is no mark


def test_every_kind_has_attacks() -> None:
    assert set(KINDS) == {attack.kind for attack in listed()}
