"""Commands: what a person or a run wants a robot to do, its signature, and the robot's answers.

Pure: robot, server and client use the same types, the same checks of foreign bytes and the same
bytes to sign. A command of risk ``record`` is not signed; all others are, by a person's Ed25519
key, over ``signed_bytes``.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
import uuid
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NoReturn, TypeAlias

import msgspec
from msgspec import Meta, Struct

from amberbox.core import ed25519
from amberbox.core.errors import AmberboxError
from amberbox.core.units import in_unit

Risk = Literal["record", "state", "moves"]
# Ascending: who may order one risk may order those before it
RISKS: tuple[Risk, ...] = ("record", "state", "moves")

AnswerState = Literal[
    "accepted", "refused", "done", "failed", "aborted", "outcome_unknown", "expired"
]
# States after which nothing more comes
FINAL = frozenset({"refused", "done", "failed", "aborted", "outcome_unknown", "expired"})

# Longest time to live that a robot accepts, seconds
MOST_TTL_S = 60
# The built-in action of a robot that installs a model of detectors; `sha256` names the file
MODEL_INSTALL = "model.install"
CHALLENGE_BYTES = 32
# Largest encoded command, JSON text of its parameters, and JSON text of a result
COMMAND_BYTES = 64 << 10
PARAMETERS_BYTES = 32 << 10
RESULT_BYTES = 64 << 10
REASON_LENGTH = 1000
# Limits of an ``OrderLimit``
MOST_ORDERS = 100
LEAST_PERIOD_S = 60.0
MOST_PERIOD_S = 7 * 86_400.0
_DEEPEST = 16
_LARGEST = 2**62
_DOMAIN = b"amberbox-command-1\0"
_KEY_PREFIX = "ed25519:"

_ID = re.compile(r"[0-9a-f]{32}")
# ``\Z`` and not ``$``, which would let a line end pass
CommandId: TypeAlias = Annotated[str, Meta(pattern=r"\A[0-9a-f]{32}\Z")]
KeyId: TypeAlias = Annotated[str, Meta(pattern=r"\A[0-9a-f]{16}\Z")]
# A robot, an action, a server
_Name: TypeAlias = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9_.-]{1,64}\Z")]
# A person, a run, a step: a line of text
_Label: TypeAlias = Annotated[str, Meta(max_length=128, pattern=r"\A[^\x00-\x1f\x7f-\x9f]*\Z")]
_Number: TypeAlias = Annotated[int, Meta(ge=0, le=_LARGEST)]
_TimeNs: TypeAlias = Annotated[int, Meta(ge=-_LARGEST, le=_LARGEST)]


class CommandError(AmberboxError):
    """Data that are no command, or a command that no robot accepts."""


class CommandSignature(Struct, frozen=True):
    """A person's signature and what it covers besides the command.

    ``lease`` is the number of the lease, ``challenge`` the 32 bytes that the robot minted,
    ``ttl_s`` how long after minting the command may be accepted, ``server`` the server's id.
    """

    key_id: KeyId
    lease: _Number
    challenge: Annotated[bytes, Meta(min_length=CHALLENGE_BYTES, max_length=CHALLENGE_BYTES)]
    ttl_s: _Number
    server: _Name
    signature: Annotated[bytes, Meta(max_length=ed25519.SIGNATURE_BYTES)] = b""


class Command(Struct, frozen=True):
    """What a person or a run wants a robot to do.

    ``parameters`` is the JSON text of an object as it was signed, never encoded again. ``issuer``
    is the name of the person at the server, which no signature covers.
    ``created_ns`` and ``expires_ns`` are the server's wall clock; the robot ignores them.
    """

    id: CommandId
    robot: _Name
    action: _Name
    parameters: Annotated[str, Meta(max_length=PARAMETERS_BYTES)]
    issuer: _Label
    risk: Risk
    run: _Label = ""
    step: _Label = ""
    created_ns: _TimeNs = 0
    expires_ns: _TimeNs = 0
    signature: CommandSignature | None = None


class CommandAnswer(Struct, frozen=True):
    """What the robot states about a command.

    ``result`` is JSON text, ``at_ns`` the robot's wall clock, ``mono_ns`` its time since ``boot``
    began. ``number`` is the order of the robot's answers, from 1; 0 for a refusal that the robot
    could not store, which comes again with a number, or that is about no command of it, or about
    one that it cannot read.
    """

    id: CommandId
    state: AnswerState
    reason: Annotated[str, Meta(max_length=REASON_LENGTH)] = ""
    result: Annotated[str, Meta(max_length=RESULT_BYTES)] = ""
    at_ns: _TimeNs = 0
    boot: Annotated[str, Meta(max_length=64)] = ""
    mono_ns: _Number = 0
    number: _Number = 0


@dataclass(frozen=True, slots=True)
class OrderLimit:
    """How often a rule may order: ``most`` times in ``per_s`` seconds of the computer's uptime.

    Orders from before the computer's start count as if made at its start, so that no clock and no
    reboot shortens the time.
    """

    most: int
    per_s: float

    @classmethod
    def from_text(cls, text: str) -> OrderLimit:
        """Read ``3 per 1 h``; raises ValueError with a sentence for anything else."""
        number, _, period = text.partition(" per ")
        if not (number.strip().isdecimal() and period.strip()):
            raise ValueError("is no limit; write: 3 per 1 h")
        limit = cls(int(number), float(in_unit(period, "s")))
        if not 1 <= limit.most <= MOST_ORDERS:
            raise ValueError(f"must allow from 1 to {MOST_ORDERS} orders")
        if not LEAST_PERIOD_S <= limit.per_s <= MOST_PERIOD_S:
            raise ValueError("must be per 1 min or longer, up to per 7 d")
        return limit

    def __str__(self) -> str:
        hours, minutes = self.per_s / 3600, self.per_s / 60
        period = f"{hours:g} h" if hours >= 1 else f"{minutes:g} min"
        return f"{self.most} per {period}"


class LeaseState(Struct, frozen=True):
    """Which run holds a robot; free without a ``holder``.

    ``number`` is the fencing number, which only grows. ``reason`` is why a request for the lease
    was refused, empty where it was granted.
    """

    number: _Number = 0
    holder: _Label = ""
    run: _Label = ""
    reason: Annotated[str, Meta(max_length=REASON_LENGTH)] = ""


_ENCODER = msgspec.msgpack.Encoder()
_DECODER: msgspec.msgpack.Decoder[Command] = msgspec.msgpack.Decoder(Command)


class _WithId(Struct):
    """A command of another version, as far as any version has to know it."""

    id: CommandId


_ID_DECODER: msgspec.msgpack.Decoder[_WithId] = msgspec.msgpack.Decoder(_WithId)


def new_command_id() -> str:
    """Return a random id for a command, 32 hex digits."""
    return uuid.uuid4().hex


def is_command_id(text: str) -> bool:
    """Return whether a text has the form of a command's id."""
    return _ID.fullmatch(text) is not None


def encode_command(command: Command) -> bytes:
    """Encode a command (msgpack); raises CommandError for one that no robot would decode."""
    data = _ENCODER.encode(command)
    decode_command(data)
    return data


def decode_command(data: bytes) -> Command:
    """Decode and check a command; raises CommandError for hostile or damaged data."""
    if len(data) > COMMAND_BYTES:
        raise CommandError(f"a command of {len(data)} bytes: {COMMAND_BYTES} are the most")
    try:
        command = _DECODER.decode(data)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise CommandError(f"no command: {error}") from error
    read_parameters(command.parameters)
    if command.risk == "record" and command.signature is not None:
        raise CommandError("a command of risk record is not signed")
    return command


def unread_id(data: bytes) -> str:
    """Return the id in data that ``decode_command`` refuses; empty where there is none."""
    if len(data) > COMMAND_BYTES:
        return ""
    try:
        return _ID_DECODER.decode(data).id
    except (msgspec.MsgspecError, ValueError, RecursionError):
        return ""


def read_parameters(text: str) -> dict[str, Any]:
    """Return the parameters in a JSON text.

    Raises CommandError unless it is an object whose keys differ, of finite numbers, not too deep:
    every reader then finds the same in it.
    """
    if len(text.encode("utf-8", "surrogatepass")) > PARAMETERS_BYTES:
        raise CommandError(f"the parameters have more than {PARAMETERS_BYTES} bytes")
    try:
        found = json.loads(text, object_pairs_hook=_distinct, parse_constant=_not_finite)
        json.dumps(found, allow_nan=False, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise CommandError(f"the parameters are no JSON: {error}") from error
    if not isinstance(found, dict):
        raise CommandError("the parameters are no JSON object", 'write {"name": value}')
    if _depth(found) > _DEEPEST:
        raise CommandError("the parameters are nested too deeply")
    return found


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is given twice")
    return found


def _not_finite(word: str) -> NoReturn:
    raise ValueError(f"{word} is not finite")


def _depth(value: object) -> int:
    if not isinstance(value, (dict, list)):
        return 0
    inner = value.values() if isinstance(value, dict) else value
    return 1 + max(map(_depth, inner), default=0)


def signed_bytes(command: Command, signature: CommandSignature) -> bytes:
    """Return the bytes that a signature covers.

    A domain, then each field as a 4-byte big-endian length and its UTF-8 or raw bytes; whole
    numbers in decimal. The parameters are the text as it is, so no number is formatted again.
    """
    fields = (
        command.id, command.robot, signature.server, command.run, command.step, command.action,
        command.parameters, command.risk, str(signature.lease), signature.challenge,
        str(signature.ttl_s),
    )  # fmt: skip
    parts = [field if isinstance(field, bytes) else field.encode() for field in fields]
    return _DOMAIN + b"".join(len(part).to_bytes(4, "big") + part for part in parts)


def sign_command(
    command: Command, private: bytes, *, lease: int, challenge: bytes, ttl_s: int, server: str
) -> Command:
    """Return a command signed with a person's private key, 32 bytes.

    Raises CommandError for a command that no robot would decode.
    """
    unsigned = CommandSignature(
        key_id(ed25519.public_key_of(private)), lease, challenge, ttl_s, server
    )
    made = ed25519.sign(private, signed_bytes(command, unsigned))
    signed = msgspec.structs.replace(
        command, signature=msgspec.structs.replace(unsigned, signature=made)
    )
    encode_command(signed)
    return signed


def verify_command(command: Command, public: bytes) -> bool:
    """Return whether a command carries a valid signature of a public key, 32 bytes."""
    signature = command.signature
    if signature is None or signature.key_id != key_id(public):
        return False
    return ed25519.is_signed(public, signature.signature, signed_bytes(command, signature))


def key_id(public: bytes) -> str:
    """Return the id of a public key: the first 16 hex digits of its SHA-256."""
    return hashlib.sha256(public).hexdigest()[:16]


def key_text(public: bytes) -> str:
    """Write a public key as text: ``ed25519:BASE64``."""
    return _KEY_PREFIX + base64.b64encode(public).decode()


def parse_key_text(text: str) -> bytes:
    """Read a public key from ``ed25519:BASE64``; raises CommandError for anything else."""
    hint = "write ed25519: and 44 characters of Base64, as 'amberbox sign' shows it"
    if not text.startswith(_KEY_PREFIX):
        raise CommandError("a public key starts with ed25519:", hint)
    try:
        public = base64.b64decode(text.removeprefix(_KEY_PREFIX), validate=True)
    except (binascii.Error, ValueError) as error:
        raise CommandError(f"no public key: {error}", hint) from error
    if len(public) != ed25519.KEY_BYTES:
        raise CommandError(f"a public key has {ed25519.KEY_BYTES} bytes, not {len(public)}", hint)
    if key_text(public) != text:
        raise CommandError("the last character of a public key is another one", hint)
    return public
