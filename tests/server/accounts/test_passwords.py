"""Passwords: argon2id by RFC 9106, equal work for all accounts, never in the event loop."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from argon2 import Type, extract_parameters

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server.accounts import passwords as module
from amberbox.server.accounts.passwords import (
    HashCost,
    Passwords,
    TooManyError,
    refuse_weak,
    weakness,
)
from amberbox.testing.clock import PATIENCE_S
from tests.server.accounts.stand import CHEAP, PASSWORD


def test_the_cost_is_what_rfc_9106_recommends() -> None:
    made = Passwords()
    found = extract_parameters(made.hash(PASSWORD))
    made.close()
    assert found.type is Type.ID
    assert (found.time_cost, found.memory_cost, found.salt_len) == (3, 64 * 1024, 16)
    assert found.hash_len == 32


def test_a_password_is_recognised(passwords: Passwords, hashed: str) -> None:
    assert passwords.verify(hashed, PASSWORD)
    assert not passwords.verify(hashed, PASSWORD + " ")
    assert not passwords.verify(hashed, "")
    assert not passwords.verify(hashed, "x" * 100_000)
    assert passwords.hash(PASSWORD) != hashed  # another salt


def test_the_same_letters_typed_elsewhere_are_the_same(passwords: Passwords) -> None:
    composed, apart = "vier grüne Züge fahren", "vier gru\u0308ne Zu\u0308ge fahren"
    assert composed != apart
    assert passwords.verify(passwords.hash(composed), apart)


def test_nobody_has_no_password(passwords: Passwords) -> None:
    assert not passwords.verify(None, PASSWORD)
    assert not passwords.verify(None, "the password of nobody")


class _Counting(Passwords):
    """Notes against which hash a password is compared."""

    compared: list[str]

    def _matches(self, held: str, password: str) -> bool:
        self.compared.append(held)
        return super()._matches(held, password)


def test_an_unknown_account_costs_as_much_as_a_known_one() -> None:
    made = _Counting(CHEAP)
    made.compared = []
    held = made.hash(PASSWORD)
    assert not made.verify(held, "wrong")
    assert not made.verify(None, "wrong")
    known, unknown = map(extract_parameters, made.compared)
    made.close()
    assert known == unknown


def test_another_cost_is_noticed(passwords: Passwords, hashed: str) -> None:
    dearer = Passwords(HashCost(passes=2, memory_kib=8, threads=1))
    assert not passwords.is_outdated(hashed)
    assert dearer.is_outdated(hashed)
    assert dearer.verify(hashed, PASSWORD)
    dearer.close()


def test_a_hash_that_cannot_be_read_is_an_error(passwords: Passwords) -> None:
    with pytest.raises(AmberboxError, match="cannot be read"):
        passwords.verify("$argon2id$broken", PASSWORD)


class _Held(Passwords):
    """Waits in a comparison until it is released."""

    def __init__(self) -> None:
        super().__init__(CHEAP)
        self.began = threading.Semaphore(0)
        self.go = threading.Event()

    def _matches(self, held: str, password: str) -> bool:
        self.began.release()
        assert self.go.wait(PATIENCE_S)
        return super()._matches(held, password)


def test_the_event_loop_goes_on_while_passwords_are_checked() -> None:
    made = _Held()
    held = made.hash(PASSWORD)

    async def both() -> bool:
        checking = asyncio.create_task(made.apart(made.verify, held, PASSWORD))
        await asyncio.get_running_loop().run_in_executor(None, made.began.acquire)
        assert not checking.done()
        made.go.set()  # reached only because the loop was free
        return await checking

    assert asyncio.run(both())
    made.close()


def test_two_at_a_time_and_a_queue_that_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_WAITING", 1)
    made = _Held()
    held = made.hash(PASSWORD)
    with ThreadPoolExecutor(3) as threads:
        running = [threads.submit(made.verify, held, PASSWORD) for _ in range(2)]
        assert made.began.acquire(timeout=PATIENCE_S)
        assert made.began.acquire(timeout=PATIENCE_S)
        running.append(threads.submit(made.verify, held, PASSWORD))
        _until(lambda: made._queue._value == 0)
        assert not made.began.acquire(blocking=False)
        with pytest.raises(TooManyError):
            made.verify(held, PASSWORD)
        made.go.set()
        assert [one.result(10) for one in running] == [True] * 3
    made.close()


def _until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end
        threading.Event().wait(0.001)


@pytest.mark.parametrize(
    "password",
    [
        "elevenchars",
        "x" * 300,
        "aaaaaaaaaaaaaaa",
        "abcabcabcabcabc",
        "password1234",
        "PasswordPassword",
        "P@ssw0rd2024!",
        "123456789012",
        "1234567890123456",
        "abcdefghijklm",
        "zyxwvutsrqponm",
        "qwertyuiop12",
        "1q2w3e4r5t6y",
        "Sommer2026!!",
        "ropod-hospital-robot",
        "amberbox-server",
        "admin-admin-admin",
        "anna.mueller2026",
        "Mueller-Anna-12",
        "iloveliverpool",
        "manchesterunited",
        "ilovemanchester",
        "chelseaforever1",
        "P@55w0rd!1234567",
        "\U0001d4c5\U0001d4b6\U0001d4c8\U0001d4c8word1234",  # in script letters
    ],
)
def test_passwords_that_are_tried_first_are_refused(password: str) -> None:
    with pytest.raises(UsageError, match="this password is refused: it "):
        refuse_weak(password, "anna.mueller")


@pytest.mark.parametrize(
    "password",
    [
        "correct horse battery staple",
        "mein blauer schrank singt",
        "hkT3!xWq92mz",
        "tischlampe77gruen",
        "die Äpfel sind im Keller",
        "4@8({[<3691!|0$5+72%hx4@8kq{[<36",  # of which zxcvbn alone would make seconds
    ],
)
def test_good_passwords_are_taken(password: str) -> None:
    assert weakness(password, "anna.mueller") is None
