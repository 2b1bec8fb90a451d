"""Zarr's store on an object store. It is a module of its own, because zarr takes long to import."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from zarr.storage import ObjectStore

from services.core.files.server_faults import translate_server_errors

if TYPE_CHECKING:
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype


class ErrorTranslatingStore(ObjectStore[Any]):
    """Zarr's store on an object store that raises this project's errors."""

    async def get(
        self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None
    ) -> Buffer | None:  # fmt: skip
        """See zarr."""
        with translate_server_errors(_url_of(self.store)):
            return await super().get(key, prototype, byte_range)

    async def set(self, key: str, value: Buffer) -> None:
        """See zarr."""
        with translate_server_errors(_url_of(self.store)):
            await super().set(key, value)

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """See zarr."""
        with translate_server_errors(_url_of(self.store)):
            await super().set_if_not_exists(key, value)

    async def delete(self, key: str) -> None:
        """See zarr."""
        with translate_server_errors(_url_of(self.store)):
            await super().delete(key)


def _url_of(client: Any) -> str:
    return f"s3://{client.config['bucket']}/{client.prefix}"
