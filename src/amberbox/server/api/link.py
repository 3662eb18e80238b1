"""Routes for robots: the link's WebSocket, uploads of journals and folders, the certificate
authority.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import msgspec
from fastapi import HTTPException, Path, Request, Response, WebSocket
from starlette.responses import FileResponse

from amberbox.link import limits, uploads
from amberbox.link.folders import TAKEN_BYTES
from amberbox.link.uploads import HoldingsQuestion, Proof, compare_holdings
from amberbox.server.bus import ServerChange
from amberbox.server.certificates import CERTIFICATE
from amberbox.server.http.auth import Fleet, Open, Routes, Who
from amberbox.server.ingest.link_server import StarletteSocket
from amberbox.server.ingest.uploads import IncomingJournal, UploadAnswer, held_journals, verdict
from amberbox.server.services.models import model_for_robot

routes = Routes("link", prefix=limits.PATH)
folder_routes = Routes("link", prefix=limits.PATH)

Store = Annotated[str, Path(pattern=r"^[0-9a-f-]{36}$")]
Name = Annotated[str, Path(max_length=64)]


@routes.socket("", "link.connect")
async def connect(websocket: WebSocket, fleet: Fleet, who: Who) -> None:
    """Talk to a robot for as long as it stays; which one it is its key says, and nothing else."""
    if "cookie" in websocket.headers or "origin" in websocket.headers:
        raise HTTPException(403, "robots come with a key, and with neither Origin nor cookie")
    await websocket.accept()
    await fleet.links.serve(StarletteSocket(websocket), who.principal.id, who.session_id)


@routes.get("/ca.pem", Open("the authority's certificate, which robots compare with their pin"))
def authority(fleet: Fleet) -> Response:
    """Give away the certificate of the server's own authority."""
    path = fleet.folder / CERTIFICATE
    if fleet.settings.certificate is None or not path.is_file():
        raise HTTPException(404, "this server has no authority of its own")
    return Response(path.read_bytes(), media_type="application/x-pem-file")


@routes.head("/journals/{store_id}/{folder}/{file}", "journals.upload")
async def look(
    store_id: Store, folder: Name, file: Name, request: Request, fleet: Fleet, who: Who
) -> Response:
    """Tell how much of a journal is here."""
    incoming = _incoming(who.principal.id, store_id, f"{folder}/{file}", request)
    return _answered(
        await fleet.threads.piece(partial(fleet.upload_service.head, incoming)), with_body=False
    )


@routes.patch("/journals/{store_id}/{folder}/{file}", "journals.upload")
async def add(
    store_id: Store, folder: Name, file: Name, request: Request, fleet: Fleet, who: Who
) -> Response:
    """Take a piece of a journal."""
    incoming = _incoming(who.principal.id, store_id, f"{folder}/{file}", request)
    offset, crc = _number(request, uploads.OFFSET), _number(request, uploads.CRC)
    if fleet.keeping.is_full:
        return _answered(UploadAnswer(507, text="the server's disk is full"))
    with fleet.threads.turn(who.principal.id):
        piece = await body_of(request, limits.PIECE_BYTES)
        answer = await fleet.threads.piece(
            lambda: fleet.upload_service.patch(incoming, offset, piece, crc)
        )
    return _answered(answer)


@routes.post("/journals/{store_id}/{folder}/{file}", "journals.upload")
async def finish(
    store_id: Store, folder: Name, file: Name, request: Request, fleet: Fleet, who: Who
) -> Response:
    """End a journal: it is verified, and what became of it is told."""
    incoming = _incoming(who.principal.id, store_id, f"{folder}/{file}", request)
    with fleet.threads.turn(who.principal.id):
        proof = _proof(await body_of(request, uploads.PROOF_BYTES))
        answer = await fleet.threads.end(partial(fleet.upload_service.post, incoming, proof))
    if answer.state == "verified":
        await fleet.threads.piece(partial(fleet.keeping.note_deleted, incoming, proof))
    return _answered(answer)


@routes.post("/held/{store_id}", "journals.upload")
async def held(store_id: Store, request: Request, fleet: Fleet, who: Who) -> Response:
    """List the journals of the robot's store that are here, where the robot counts on others."""
    robot = who.principal.id
    with fleet.threads.turn(robot):
        question = _question(await body_of(request, uploads.QUESTION_BYTES))
        answer = await fleet.threads.piece(
            lambda: compare_holdings(
                question, held_journals(fleet.database, fleet.folder, robot, store_id)
            )
        )
    fleet.bus.publish(ServerChange("holdings", robot))
    return Response(msgspec.msgpack.encode(answer), media_type="application/x-msgpack")


def _incoming(robot: str, store_id: str, journal: str, request: Request) -> IncomingJournal:
    digest = request.headers.get(uploads.SHA256, "")
    return IncomingJournal(robot, store_id, journal, digest, _number(request, uploads.BYTES))


def _number(request: Request, name: str) -> int:
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdecimal() and len(text) < 19):
        raise HTTPException(400, f"the header {name} has to be a number")
    return int(text)


async def body_of(request: Request, most: int) -> bytes:
    """Read the body of a request; raises 413 as soon as it is too large."""
    found = bytearray()
    async for piece in request.stream():
        found += piece
        if len(found) > most:
            raise HTTPException(413, f"{most} bytes at most")
    return bytes(found)


def _proof(body: bytes) -> Proof:
    try:
        return msgspec.json.decode(body, type=Proof)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise HTTPException(400, f"the proof cannot be read: {error}") from error


def _question(body: bytes) -> HoldingsQuestion:
    try:
        return msgspec.msgpack.decode(body, type=HoldingsQuestion)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise HTTPException(400, f"the question cannot be read: {error}") from error


def _answered(answer: UploadAnswer, *, with_body: bool = True) -> Response:
    about = {uploads.OFFSET: str(answer.offset), uploads.STATE: answer.state}
    has_body = with_body and answer.status != 204
    content = msgspec.json.encode(verdict(answer)) if has_body else b""
    return Response(content, answer.status, about, "application/json" if has_body else None)


Hash = Annotated[str, Path(pattern="^[0-9a-f]{64}$")]


@folder_routes.get("/models/{sha256}", "link.connect")
def read_model(sha256: Hash, fleet: Fleet, who: Who) -> FileResponse:
    """Give a robot the model of detectors that a command of its own names."""
    return FileResponse(model_for_robot(fleet, who.principal.id, sha256))


@folder_routes.put("/folders/{config_hash}", "journals.upload", status_code=204)
async def put_folder(config_hash: Hash, request: Request, fleet: Fleet, who: Who) -> Response:
    """Take the folder of the robot that sends it; one that is known stays as it is."""
    robot = who.principal.id
    with fleet.threads.turn(robot):
        packed = await body_of(request, TAKEN_BYTES)
        await fleet.threads.folder(partial(fleet.folders.keep, robot, config_hash, packed))
    return Response(status_code=204)
