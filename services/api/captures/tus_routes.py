"""Routes of the upload protocol tus 1.0 below ``/v1/uploads``; each upload is one file of a capture.

Annotations are evaluated here, because FastAPI reads them.
"""

from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Depends, Header, HTTPException, Path, Request, Response
from fastapi.routing import APIRoute
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive, Scope, Send

from services.api.auth.scopes import CurrentViewer, needs
from services.api.captures.receiving import ClientSilentError, receive
from services.api.captures.uploads import Upload, Uploads, upload_path
from services.api.http.problems import refusals
from services.client import tus
from services.client.errors import UploadError
from services.pipeline.database import MAX_ID

FileNumber = Annotated[int, Path(ge=0, le=MAX_ID, description="number of the file in the capture's manifest, from 0")]


class TusRoute(APIRoute):
    """A route that names the version of the protocol in every answer, refusals included."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def send_with_version(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)["Tus-Resumable"] = tus.VERSION
            await send(message)

        await super().handle(scope, receive, send_with_version)


def require_version(
    tus_resumable: Annotated[str | None, Header(json_schema_extra={"const": tus.VERSION})] = None,
) -> None:
    """Refuse a request in another version of the protocol, or in none."""
    if tus_resumable != tus.VERSION:
        raise HTTPException(412, f"Header Tus-Resumable must be {tus.VERSION}; send it", {"Tus-Version": tus.VERSION})


def build_tus_router(uploads: Uploads) -> APIRouter:
    """Build the routes over the given uploads."""
    router = APIRouter(
        prefix="/v1/uploads",
        route_class=TusRoute,
        responses=refusals(404, 408, 409, 410, 412, 413, 415, 422, 423, 460, 507),
        tags=["uploads"],
    )
    versioned = [Depends(require_version)]

    def upload_headers(upload: Upload) -> dict[str, str]:
        metadata = tus.format_metadata({"capture": upload.row.capture, "path": upload.row.file.path})
        return _progress(upload.offset, upload.expires_s) | {
            "Upload-Length": str(upload.row.file.bytes),
            "Upload-Metadata": metadata,
        }

    @router.options("", status_code=204, dependencies=[needs("read")])
    def options() -> Response:
        """What of tus is spoken here."""
        headers = {
            "Tus-Version": tus.VERSION,
            "Tus-Extension": tus.EXTENSIONS,
            "Tus-Max-Size": str(uploads.limits.largest_file_bytes),
        }
        return Response(status_code=204, headers=headers | {"Tus-Checksum-Algorithm": ",".join(tus.DIGEST_BYTES)})

    @router.post("", status_code=201, dependencies=[*versioned, needs("submit")], response_class=Response)
    def create(
        viewer: CurrentViewer,
        upload_length: Annotated[int, Header(ge=0, le=2**53)],
        upload_metadata: Annotated[str, Header(max_length=2000)],
    ) -> Response:
        """Start to send one file of an open capture; Upload-Metadata names 'capture' and 'path'.

        Starting again changes nothing.
        """
        metadata = tus.parse_metadata(upload_metadata)
        if missing := {"capture", "path"} - set(metadata):
            raise UploadError(
                f"Upload-Metadata lacks {min(missing)!r}; name the capture's id and the file's path in it."
            )
        upload = uploads.create(metadata["capture"], metadata["path"], upload_length, viewer)
        return Response(
            status_code=201,
            headers={"Location": upload_path(upload.row.capture, upload.row.number)} | upload_headers(upload),
        )

    @router.head("/{capture}/{number}", dependencies=[*versioned, needs("submit")], response_class=Response)
    def head(capture: str, number: FileNumber) -> Response:
        """How far the file is."""
        return Response(headers=upload_headers(uploads.find(capture, number)))

    @router.patch(
        "/{capture}/{number}",
        status_code=204,
        dependencies=[*versioned, needs("submit")],
        response_class=Response,
        openapi_extra={
            "requestBody": {
                "content": {tus.CHUNK_TYPE: {"schema": {"type": "string", "format": "binary"}}},
                "required": True,
            }
        },
    )
    async def append(
        capture: str,
        number: FileNumber,
        request: Request,
        upload_offset: Annotated[int, Header(ge=0, le=2**53)],
        content_type: Annotated[str | None, Header(json_schema_extra={"const": tus.CHUNK_TYPE})] = None,
        upload_checksum: Annotated[str | None, Header(max_length=200)] = None,
    ) -> Response:
        """Send the next bytes.

        The answer comes once they are durable, and to the last ones once the file's SHA-256 is verified.
        """
        if content_type != tus.CHUNK_TYPE:
            raise HTTPException(415, f"Header Content-Type must be {tus.CHUNK_TYPE}; send it")
        checksum = tus.parse_checksum(upload_checksum) if upload_checksum is not None else None
        with suppress(ClientDisconnect):
            try:
                received = await receive(uploads, capture, number, upload_offset, aiter(request.stream()), checksum)
            except ClientSilentError:
                raise HTTPException(
                    408,
                    f"Nothing was sent for {uploads.limits.silence_s:g} s; ask for Upload-Offset and go on from there",
                ) from None
            return Response(status_code=204, headers=_progress(received.offset, received.expires_s))
        return Response(status_code=204)  # to nobody: the client has gone away

    @router.delete(
        "/{capture}/{number}", status_code=204, dependencies=[*versioned, needs("submit")], response_class=Response
    )
    def terminate(capture: str, number: FileNumber) -> Response:
        """Discard what was received of the file."""
        uploads.terminate(capture, number)
        return Response(status_code=204)

    return router


def _progress(offset: int, expires_s: float) -> dict[str, str]:
    return {"Upload-Offset": str(offset), "Upload-Expires": tus.format_expiry(expires_s), "Cache-Control": "no-store"}
