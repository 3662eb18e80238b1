"""The faulty proxy: the same faults for the same seed, and the requested faults in frames."""

from __future__ import annotations

import socket
import threading

from amberbox.testing.clock import PATIENCE_S
from amberbox.testing.fault_proxy import Faults, FrameFaults, Mangler, Proxy, plan

HEAD = b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n"


def frame(number: int, size: int = 300) -> bytes:
    """Make an unmasked binary frame whose content is one byte again and again."""
    return bytes([0x82, 126]) + size.to_bytes(2, "big") + bytes([number]) * size


def test_a_seed_plans_the_same_faults_again() -> None:
    faults = Faults()
    planned = [plan(faults, 5, n) for n in range(50)]
    assert planned == [plan(faults, 5, n) for n in range(50)]
    assert planned != [plan(faults, 6, n) for n in range(50)]
    assert {one.kind for one in planned} == set(faults.kinds)


def test_frames_are_sent_twice_swapped_held_and_damaged() -> None:
    for fault in ("duplicate", "reorder", "corrupt", "hold"):
        mangler = Mangler(FrameFaults(**{fault: 0.5}), 3)
        sent = b"".join(frame(n) for n in range(40))
        out = mangler.pass_on(HEAD + sent[:1000], up=True) + mangler.pass_on(sent[1000:], up=True)
        assert out.startswith(HEAD) and out != HEAD + sent
        assert set(mangler.done) == {fault}
        again = Mangler(FrameFaults(**{fault: 0.5}), 3)
        assert again.pass_on(HEAD + sent, up=True) == out


def test_without_faults_bytes_pass_as_they_are() -> None:
    sent = b"".join(frame(n) for n in range(40))
    mangler = Mangler(FrameFaults(), 3)
    parts = [sent[n : n + 77] for n in range(0, len(sent), 77)]
    assert b"".join(mangler.pass_on(part, up=False) for part in (HEAD, *parts)) == HEAD + sent


def test_what_is_no_websocket_passes_as_it_is() -> None:
    mangler = Mangler(FrameFaults(0.5, 0.2, 0.2, 0.1), 3)
    sent = b"PATCH / HTTP/1.1\r\n\r\n" + b"".join(frame(n) for n in range(40))
    parts = [sent[n : n + 77] for n in range(0, len(sent), 77)]
    assert b"".join(mangler.pass_on(part, up=True) for part in parts) == sent
    assert not mangler.done


def test_a_connection_ends_in_the_middle_after_so_many_bytes() -> None:
    listener = socket.create_server(("127.0.0.1", 0))
    got = bytearray()

    def receive() -> None:
        server, _ = listener.accept()
        while data := server.recv(65536):
            got.extend(data)
        server.close()

    thread = threading.Thread(target=receive)
    thread.start()
    faults = Faults(("mid_frame",), after_bytes=(10_000, 10_000))
    with Proxy(listener.getsockname()[1], faults) as proxy:
        with socket.create_connection(("127.0.0.1", proxy.port)) as client:
            client.sendall(bytes(9_000))
            try:
                client.sendall(bytes(50_000))
                client.settimeout(PATIENCE_S)
                assert client.recv(1) == b""
            except ConnectionError:
                pass  # a reset is an end, too
        thread.join(PATIENCE_S)
    listener.close()
    assert len(got) == 10_000 and proxy.struck == ["mid_frame"]
