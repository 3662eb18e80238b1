"""Commands in the browser: a real robot that drives, people with keys, one of them on a phone."""

from __future__ import annotations

import json
import math
import os
import random
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import zmq
from playwright.sync_api import expect

import amberbox.sim
from amberbox.client import credentials, signing_key
from amberbox.core.command import Command, CommandSignature, Risk, parse_key_text, signed_bytes
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import find_user
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.http.auth import COOKIE
from amberbox.testing.clock import PATIENCE_S, wait_until
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, judge
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA
from tests.support.processes import command

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

HERE = f"/robots/{ROBOT}/commands"
_BYTES = """async (cases) => {
    const { $need } = await import(document.querySelector('script[type="module"]').src)
    const { signedBytes, fromHex, toHex } = $need("command_bytes.js")
    return cases.map(([order, { challenge, lease, ...rest }]) =>
        toHex(signedBytes(order, { ...rest, lease: BigInt(lease), challenge: fromHex(challenge) })))
}"""


@dataclass
class World:
    """A robot, its server, and who looks at its pages."""

    robot: Commanded
    endpoint: str
    open: Callable[..., Page]

    def place(self) -> tuple[float, float]:
        """Ask the simulated robot where it is."""
        with zmq.Context() as context, context.socket(zmq.REQ) as socket:
            socket.linger = 0
            socket.connect(self.endpoint)
            socket.send_json({"do": "status"})
            assert socket.poll(int(PATIENCE_S * 1000))
            x_m, y_m, _ = json.loads(socket.recv())["pose"]
        return x_m, y_m

    def trust(self, line: str) -> None:
        """Let a key order what changes a state."""
        trust = self.robot.folder.parent / "trust.yaml"
        trust.write_text(f'{trust.read_text()}  browser: {{key: "{line}", risk: state}}\n')


@pytest.fixture(scope="module")
def running(
    tmp_path_factory: pytest.TempPathFactory, browser: Browser
) -> Iterator[tuple[Commanded, str]]:
    """The simulated robot with its command process, and its server."""
    folder = tmp_path_factory.mktemp("commands")
    actions = (Path(amberbox.sim.__file__).parent / "folder" / "actions" / "sim.yaml").read_text()
    with simulated_robot(folder) as endpoint:
        adapted = actions.replace("tcp://127.0.0.1:5557", endpoint)
        with commanded(folder, endpoint, adapted) as found:
            yield found, endpoint


@pytest.fixture
def world(running: tuple[Commanded, str], page_as: PageAs) -> World:
    robot, endpoint = running

    def opened(name: str, **look: Any) -> Page:
        database = ServerDatabase(robot.data / FILE)
        with database.begin() as connection:
            user = find_user(connection, name)
            began = begin_session(connection, time.time_ns(), user.user_id, "127.0.0.1", "tests")
        database.close()
        page = page_as(at=robot.url, **look)
        page.context.add_cookies([{"name": COOKIE, "value": began.secret, "url": robot.url}])
        return page

    return World(robot, endpoint, opened)


@pytest.fixture
def signs(
    running: tuple[Commanded, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], subprocess.Popen[str]]:
    """What starts ``amberbox sign`` at Anna's computer with the words that a page shows."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv(credentials.VARIABLE, running[0].tokens["anna"])
    monkeypatch.setattr("amberbox.core.ed25519.new_private_key", lambda: ANNA.private)
    signing_key.make_key("anna")

    def start(line: str) -> subprocess.Popen[str]:
        program, *words = line.split()
        assert program == "amberbox"
        return subprocess.Popen(
            command(*words, "--yes-to", "drive_*", "--once"), text=True, env=dict(os.environ),
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip

    return start


def order(page: Page, action: str, **values: str) -> None:
    """Fill in the form of an action."""
    page.goto(f"{HERE}?action={action}")
    for name, value in values.items():
        page.locator(f'#action-{action} [name="p.{name}"]').fill(value)


def test_the_bytes_that_a_browser_signs_are_those_of_the_robot(page_as: PageAs) -> None:
    chance = random.Random(7)
    cases, wanted = [], []
    for _ in range(300):
        made, signature = some_command(chance)
        about = {name: getattr(made, name) for name in
                 ("id", "robot", "action", "parameters", "risk", "run", "step")}  # fmt: skip
        covered = {"server": signature.server, "lease": str(signature.lease),
                   "challenge": signature.challenge.hex(), "ttlS": signature.ttl_s}  # fmt: skip
        cases.append([about, covered])
        wanted.append(signed_bytes(made, signature).hex())
    page = page_as()
    page.goto("/help")
    assert page.evaluate(_BYTES, cases) == wanted


def some_command(chance: random.Random) -> tuple[Command, CommandSignature]:
    """Compose a command of random texts in all alphabets, also empty and long ones."""

    def text(most: int) -> str:
        ranges = ((32, 126), (160, 0x24F), (0x4E00, 0x4FFF), (0x1F300, 0x1F6FF))
        return "".join(
            chr(chance.randint(*chance.choice(ranges))) for _ in range(chance.randint(0, most))
        )

    risks: list[Risk] = ["state", "moves"]
    parameters = json.dumps({text(20): text(100), "x": chance.random()}, ensure_ascii=False)
    made = Command(
        f"{chance.getrandbits(128):032x}", "r-1_x", "a.b", parameters, "", chance.choice(risks),
        text(128), text(128),
    )  # fmt: skip
    signature = CommandSignature(
        "0" * 16, chance.getrandbits(62), chance.randbytes(32), chance.randint(0, 60), "s-1"
    )
    return made, signature


def test_a_motion_is_ordered_signed_confirmed_on_a_phone_and_aborted(
    world: World, signs: Callable[[str], subprocess.Popen[str]]
) -> None:
    anna, olga = world.open("anna"), world.open("olga", width=390)
    olga.goto(HERE)
    before = world.place()
    order(anna, "drive_linear", distance_m="3")
    anna.locator("#action-drive_linear [data-store]").click()
    line = anna.locator(".signature-line").inner_text()
    expect(olga.locator("#commands-unsigned").get_by_text("drive_linear")).to_be_visible()
    signer = signs(line)
    entry = olga.locator("#commands-code input[name=code]")
    expect(entry).to_be_visible()
    judge(olga, "commands-code", EVERY_LOOK)
    judge(anna, "command-code")
    assert math.dist(before, world.place()) < 0.1, "nobody has confirmed it"
    olga.set_viewport_size({"width": 390, "height": 800})
    entry.fill(world.robot.code())
    olga.locator("#commands-code button").click()
    expect(olga.locator("#command-now").get_by_text("being done")).to_be_visible()
    expect(anna.locator("#command-now").get_by_text("being done")).to_be_visible()
    wait_until(lambda: math.dist(before, world.place()) > 0.2, "the robot drives")
    plain = world.open("olga", width=390, java_script_enabled=False)
    plain.goto(HERE)
    plain.get_by_role("button", name="Abort all").click()
    expect(plain.get_by_text("has been told to stop")).to_be_visible()
    expect(anna.locator("#command-now").get_by_text("aborted by olga")).to_be_visible()
    judge(anna, "command-aborted", EVERY_LOOK)
    out, error = signer.communicate(timeout=PATIENCE_S)
    assert "aborted by olga" in out, error


def test_a_browser_with_a_key_signs_what_changes_a_state(world: World) -> None:
    page = world.open("anna", expects=["409 POST"])
    page.goto(HERE)
    expect(page.get_by_text("This browser has no key yet")).to_be_visible()
    page.goto("/account")
    page.get_by_role("button", name="Make a key").click()
    expect(page.locator("[data-key-line]")).to_have_text(re.compile("^ed25519:"))
    line = page.locator("[data-key-line]").inner_text()
    assert len(parse_key_text(line)) == 32
    assert world.robot.server_id in page.locator("[data-key-trust]").inner_text()
    judge(page, "account-key", EVERY_LOOK, within=["#browser-key"])
    send = "#action-resume_tasks [data-sign-and-send]"
    order(page, "resume_tasks")
    page.locator(send).click()
    expect(page.locator("#command-now").get_by_text("refused")).to_be_visible()
    expect(page.get_by_text("Keep this page open")).to_have_count(0)
    world.trust(line)
    order(page, "resume_tasks")
    page.locator(send).click()
    expect(
        page.locator("#command-now [role=status]").get_by_text("done", exact=True)
    ).to_be_visible()
    with world.robot.fleet() as fleet:
        newest = fleet.commands(ROBOT, limit=1)[0]
        wait_until(lambda: not fleet.actions(ROBOT).lease.holder, "the robot is free again")
    assert (newest.state, newest.issuer) == ("done", "anna")
    page.goto("/account")
    expect(page.locator("[data-key-id]")).to_have_text(newest.key_id)
    page.get_by_role("button", name="Forget this key").click()
    page.locator("[data-forget-key]").click()
    expect(page.get_by_role("button", name="Make a key")).to_be_visible()


def test_without_scripts_it_is_stored_and_withdrawn(world: World) -> None:
    page = world.open("anna", width=390, java_script_enabled=False, expects=["400"])
    page.goto(f"{HERE}?action=drive_linear&p.distance_m=1")
    form = page.locator("#action-drive_linear")
    assert form.locator('[name="p.distance_m"]').input_value() == "1"
    expect(form.locator("[data-sign-and-send]")).to_be_hidden()
    form.locator("[data-store]").click()
    expect(page.locator("#command-now").get_by_text("waits for a signature")).to_be_visible()
    page.goto("/commands")
    page.get_by_role("button", name="Withdraw").click()
    expect(page.get_by_text("Nothing waits for a signature")).to_be_visible()


def test_on_plain_http_a_browser_says_that_it_cannot_sign(world: World) -> None:
    page = world.open("anna")
    page.add_init_script("Object.defineProperty(window, 'isSecureContext', {value: false})")
    page.goto(HERE)
    expect(page.get_by_text("does not come over https")).to_be_visible()
    expect(page.locator("[data-sign-and-send]").first).to_be_hidden()
