"""Whose signatures are believed, and from where on nothing is signed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from amberbox.blackbox.segments import manifest as mf
from amberbox.blackbox.segments.entries import Signature
from amberbox.blackbox.signing.keys import PUBLIC, can_sign, is_key, public_key, to_pem
from amberbox.blackbox.signing.signing import STATED, SignedHeads
from amberbox.blackbox.verify.findings import BAD, Finding, as_text
from amberbox.blackbox.verify.journal import Checked
from amberbox.blackbox.verify.manifest import CheckedManifest
from amberbox.blackbox.verify.mended import without_one_bit


@dataclass(frozen=True, slots=True)
class Trust:
    """The key that is believed, and up to which line of the manifest it has signed."""

    key: str = ""
    signed_line: int = 0
    signed_ns: int | None = None
    findings: Sequence[Finding] = ()
    notes: Sequence[str] = ()

    @property
    def is_signed(self) -> bool:
        """Tell whether there is any signature to go by."""
        return self.signed_line > 0


def check_trust(given: str, store: Path, lines: CheckedManifest) -> Trust:
    """Choose the key to believe and look at what it has signed."""
    if not can_sign():
        note = "signatures are not checked: the package cryptography is not installed"
        return Trust(notes=(note,))
    last = lines.signatures[-1][1] if lines.signatures else None
    key, notes, findings = _choose(given, store, last)
    covered = lines.signed(key)
    if last is not None and last.key != key:
        text = f"the last signature is not by {key[:16]}..., but by {last.key}"
        findings.append(Finding("altered", mf.NAME, text))
    others = {s.key for _, s in lines.signatures} - {key}
    if others and not findings:
        notes.append(f"the key was replaced: {len(others)} other signed before")
    if covered is None:
        return Trust(key, findings=findings, notes=notes)
    return Trust(key, covered[0], covered[1].at_ns, findings, notes)


def _choose(
    given: str, store: Path, last: Signature | None
) -> tuple[str, list[str], list[Finding]]:
    """Return the key to believe; one that differs from ``key.pub`` by a bit shows damage there."""
    published = public_key(store)
    if given or (last is None and published is None):
        return given, [], []
    if last is not None and published != last.key and _was(store / PUBLIC, last.key):
        return last.key, [], [Finding("damaged", PUBLIC, "one bit is flipped")]
    if published is not None:
        note = "the store's own key.pub is believed: give --key as noted at the first start"
        return published, [note], []
    text = "is gone or cannot be read; the key that the signatures state is believed"
    return "" if last is None else last.key, [], [Finding("damaged", PUBLIC, text)]


def check_public(store: Path, trust: Trust) -> Iterator[Finding]:
    """Compare the bytes of the public key's file with what was written."""
    if any(finding.file == PUBLIC for finding in trust.findings):
        return
    content, published = (store / PUBLIC).read_bytes(), public_key(store)
    if published is not None and content.decode("ascii", "replace") != to_pem(published):
        yield Finding("damaged", PUBLIC, "holds the key, but is not as it was written")


def _was(path: Path, key: str) -> bool:
    """Tell whether a file held a public key before one bit of it was flipped."""
    content = path.read_bytes() if path.exists() else b""
    return without_one_bit(content, partial(is_key, key)) is not None


def unsigned_ends(
    trust: Trust,
    lines: CheckedManifest,
    by_writer: Mapping[str, Sequence[Checked]],
    heads: SignedHeads | None,
) -> list[Finding]:
    """Say from when on no signature vouches for the manifest and for each journal."""
    if not can_sign() or not (trust.key or lines.signatures):
        return [Finding("unsigned", mf.NAME, "nothing here is signed: the store has no key")]
    signed = heads if heads is not None and heads.signature else None
    found = []
    last = max(lines.hashes.values(), default=0)
    vouched = max(trust.signed_line, lines.hashes.get(signed.manifest, 0) if signed else 0)
    if last - _own_signature(lines, last) > vouched:
        found.append(_manifest_end(last - vouched, trust.signed_ns))
    found += _unsigned_claims(lines, vouched)
    for writer in STATED:
        found += _journal_end(by_writer.get(writer, ()), lines, vouched, signed)
    return found


def _unsigned_claims(lines: CheckedManifest, vouched: int) -> Iterator[Finding]:
    """Name the files of which only lines that are not signed yet say what became of them."""
    for number, file, text in lines.claims:
        if number > vouched:
            yield Finding("unsigned", file, f"{text}, says line {number}, which is not signed")


def _own_signature(lines: CheckedManifest, last: int) -> int:
    """Count the line that holds a signature: it needs none itself."""
    return sum(number == last for number, _ in lines.signatures)


def _manifest_end(count: int, at_ns: int | None) -> Finding:
    when = f" at {as_text(at_ns)}" if at_ns is not None else ""
    return Finding("unsigned", mf.NAME, f"ends unsigned{when}: {count} lines", from_ns=at_ns)


def _journal_end(
    files: Sequence[Checked], lines: CheckedManifest, vouched: int, heads: SignedHeads | None
) -> Iterator[Finding]:
    """Find the first byte of a writer's journal that no signature vouches for."""
    loose = [(c, _covered(c, heads)) for c in files if not _is_sealed(c, lines, vouched)]
    open_ends = [(c, to) for c, to in loose if c.size > to and not _ends_at(c, to)]
    if not open_ends:
        return
    first, covered = open_ends[0]
    at_ns = first.places.end_ns(covered) if covered else first.places.start_ns()
    size = sum(checked.size - to for checked, to in open_ends)
    text = f"ends unsigned at {as_text(at_ns)}: " if at_ns is not None else "is unsigned: "
    text += f"{size} bytes in {len(open_ends)} files are vouched for by their own chain only"
    if first.torn:
        text += f"; the last {first.torn} bytes are no whole record (a crash or power cut)"
    end_ns = open_ends[-1][0].places.end_ns()
    yield Finding("unsigned", first.target.name, text, None, covered, first.size, at_ns, end_ns)


def _is_sealed(checked: Checked, lines: CheckedManifest, vouched: int) -> bool:
    """Tell whether a signed line of the manifest vouches for a whole file."""
    if any(finding.state in BAD for finding in checked.findings):
        return True  # it has been named already
    entry = lines.sealed.get(checked.target.name)
    return entry is not None and entry[0] <= vouched


def _covered(checked: Checked, heads: SignedHeads | None) -> int:
    """Return up to which byte the robot's statement vouches for a file."""
    if heads is None:
        return 0
    reaches = [r for r in heads.writers.values() if r.file == checked.target.name]
    return reaches[0].bytes if reaches else 0


def _ends_at(checked: Checked, byte: int) -> bool:
    """Tell whether nothing but the end of the file follows a link."""
    return byte > 0 and byte == checked.tail_from and checked.finished
