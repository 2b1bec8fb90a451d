"""``dentine secrets``: make and renew the certificates and the database password of a composed system."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from services.core.settings import ServerSettings

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="Where they lie: authority/, tls/ and database/.")]


def build_secrets_app(settings: Callable[[], ServerSettings]) -> typer.Typer:
    """The commands on a system's certificates and on the password of its database."""
    about = "Make and renew the certificates and the database password of a composed system."
    app = typer.Typer(no_args_is_help=True, help=about, rich_markup_mode=None)

    @app.command()
    def make(
        folder: Folder,
        renew: Annotated[
            bool, typer.Option("--renew", help="Make the certificate of the parts anew in any case.")
        ] = False,
    ) -> None:
        """Make what is absent or ends within 60 days; what is there stays."""
        from services.api.deployment.secrets import make_missing

        made = make_missing(folder, renew=renew)
        print(f"made: {', '.join(made)}" if made else "everything was there already")

    @app.command("change-password")
    def change_password(folder: Folder) -> None:
        """Give the database a new password; the parts read it at their next connection, without a restart."""
        from services.api.deployment.password_change import change_database_password

        change_database_password(settings().database_url, folder / "database" / "password")
        print("the database has a new password")

    return app
