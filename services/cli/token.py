"""``dentine token``: make, list and revoke tokens in the database itself, so that the first token can be made."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.api.auth.tokens import Tokens

Data = Annotated[
    Path | None, typer.Option(help="Folder of the server's SQLite database; default: the settings' database.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def build_token_app(default_url: Callable[[], str]) -> typer.Typer:
    """The commands on a server's tokens."""
    app = typer.Typer(no_args_is_help=True, help="Make, list and revoke the tokens of a server.", rich_markup_mode=None)

    @app.command()
    def create(
        name: Annotated[str, typer.Argument(help="Who or what uses it.")],
        scope: Annotated[
            list[str],
            typer.Option(
                help="What it may do: read, submit, operate-dome, metrics or admin; may be given several times."
            ),
        ],
        expires_days: Annotated[float | None, typer.Option(min=0, help="Days until it ends; default: never.")] = None,
        group: Annotated[
            str | None, typer.Option(help="Whose jobs and captures it sees and makes; default: its own alone.")
        ] = None,
        data: Data = None,
        as_json: Json = False,
    ) -> None:
        """Make a token and print it; it is not shown again."""
        from services.api.auth.audit import AuditedAction
        from services.api.auth.tokens import Scope
        from services.core.errors import InputError

        if unknown := [one for one in scope if one not in set(Scope)]:
            raise InputError(f"Scope {unknown[0]!r} does not exist; known are {', '.join(Scope)}.")
        with _tokens(data, default_url) as tokens:
            audited = AuditedAction("dentine token create", "command line", "local")
            issued = tokens.create(name, [Scope(one) for one in scope], expires_days, audited, group)
        if group is None and set(scope) == {Scope.READ}:
            print(
                f"dentine: Token {name} may only read and is in no group, so it sees no jobs; to see a group's, make it"
                " with --group.",
                file=sys.stderr,
            )
        print(issued.model_dump_json() if as_json else issued.token.get_secret_value())

    @app.command("list")
    def list_tokens(data: Data = None, as_json: Json = False) -> None:
        """List the tokens without their secrets."""
        with _tokens(data, default_url) as tokens:
            found = tokens.list()
        if as_json:
            print(json.dumps([token.model_dump(mode="json") for token in found]))
            return
        for token in found:
            ended = f"revoked {_day(token.revoked_s)}" if token.revoked_s else f"expires {_day(token.expires_s)}"
            who, what = f"{token.id}  {token.name}", f"{','.join(token.scopes)}  group {token.group or 'none'}"
            print(f"{who}  {what}  made {_day(token.created_s)}  {ended}  last used {_day(token.last_used_s)}")

    @app.command()
    def revoke(
        token: Annotated[str, typer.Argument(metavar="ID", help="Id or name that list prints.")], data: Data = None
    ) -> None:
        """End a token now."""
        from services.api.auth.audit import AuditedAction

        with _tokens(data, default_url) as tokens:
            ended = tokens.revoke(token, AuditedAction("dentine token revoke", "command line", "local"))
        print(f"revoked: {ended.id} {ended.name}")

    return app


@contextmanager
def _tokens(data: Path | None, default_url: Callable[[], str]) -> Iterator[Tokens]:
    from services.api.auth.tokens import Tokens
    from services.api.migrations import upgrade
    from services.core.settings import ServerSettings
    from services.pipeline.database import open_database

    engine = open_database(default_url() if data is None else ServerSettings(data=data).database_url)
    try:
        upgrade(engine)
        yield Tokens(engine)
    finally:
        engine.dispose()


def _day(time_s: float | None) -> str:
    return "never" if time_s is None else datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M UTC")
