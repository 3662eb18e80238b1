"""CAN without hardware: a DBC and an EDS file, frames of them, peers on the network and a pty."""

from __future__ import annotations

import os
import random
import select
import threading
import tty
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import numpy as np

from amberbox.core.types import Rows

DBC = """VERSION "test"
NS_ :
BS_:
BU_: Base
BO_ 513 MOTORS: 8 Base
 SG_ SPEED_L : 7|16@0- (0.5,-3) [0|0] "rad/s" Base
 SG_ SPEED_R : 16|12@1- (1,0) [0|0] "" Base
 SG_ STATE : 28|3@1+ (1,0) [0|0] "" Base
 SG_ CURRENT : 32|32@1- (1,0) [0|0] "A" Base
BO_ 2147484448 BATTERY: 8 Base
 SG_ PAGE M : 7|4@0+ (1,0) [0|0] "" Base
 SG_ VOLTAGE m0 : 8|16@1+ (0.01,0) [0|0] "V" Base
 SG_ CELL m1 : 13|14@0+ (1,0) [0|0] "mV" Base
 SG_ LEVEL : 63|8@0+ (0.5,0) [0|0] "%" Base
BO_ 514 LAMP: 1 Base
 SG_ ON : 0|1@1+ (1,0) [0|1] "" Base
VAL_ 513 STATE 0 "off" 1 "on" 5 "fault" ;
SIG_VALTYPE_ 513 CURRENT : 1;
"""

EDS = """[FileInfo]
FileName=lift.eds
; a lift with one drive
[6041]
ParameterName=Statusword
ObjectType=0x7
DataType=0x0006
[6064]
ParameterName=Position actual value
DataType=0x0004
[2100]
ParameterName=Sensor
ObjectType=0x9
[2100sub1]
ParameterName=Load
DataType=0x0008
[2100sub2]
ParameterName=Brake
DataType=0x0001
[1800]
ParameterName=TPDO 1
[1800sub1]
ParameterName=COB-ID
DataType=0x0007
DefaultValue=$NODEID+0x40000180
[1A00sub0]
DefaultValue=2
[1A00sub1]
DefaultValue=0x60410010
[1A00sub2]
DefaultValue=0x60640020
[1A00]
ParameterName=Mapping 1
[1801sub1]
DefaultValue=0x80000285
[1A01]
ParameterName=Mapping 2
[1A01sub0]
DefaultValue=1
[1A01sub1]
DefaultValue=0x60410010
[1802sub1]
ParameterValue=0x385
[1A02]
ParameterName=Mapping 3
[1A02sub0]
ParameterValue=3
[1A02sub1]
ParameterValue=0x21000201
[1A02sub2]
ParameterValue=0x00050007
[1A02sub3]
ParameterValue=0x21000120
"""


def frames(count: int, seed: int = 1) -> Sequence[can.Message]:
    """Return frames of the bus of the DBC file, some of them unknown to it."""
    chance = random.Random(seed)
    ids = [(513, False), (0x320, True), (514, False), (0x7A1, False)]
    made = []
    for number in range(count):
        identifier, extended = ids[number % len(ids)]
        data = number.to_bytes(4, "little") + chance.randbytes(4)
        made.append(
            can.Message(
                timestamp=1_700_000_000 + number * 1e-3,
                arbitration_id=identifier,
                is_extended_id=extended,
                data=data[:1] if identifier == 514 else data,
                channel=0,
            )
        )
    return made


def columns_of(rows: Rows) -> dict[str, list[Any]]:
    """Return the columns of rows as lists; no signal is a list itself."""
    return {name: np.ma.MaskedArray(column).tolist() for name, column in rows.columns.items()}


class MulticastBus:
    """A group that frames are sent to; it never leaves this computer."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.group = _group(port)
        self.peer: Any = self.open()

    def open(self) -> Any:
        """Return another participant."""
        return can.Bus(self.group, interface="udp_multicast", port=self.port, hop_limit=0)

    @property
    def block(self) -> dict[str, Any]:
        """Return the options of a source on this bus."""
        return {
            "channel": self.group,
            "interface": "udp_multicast",
            "driver": {"port": self.port, "hop_limit": 0},
        }

    def __enter__(self) -> MulticastBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.peer.shutdown()


def _group(port: int) -> str:
    """Return a group that works here: IPv4 needs a route, IPv6 needs IPv6."""
    failed = []
    for group in ("239.74.163.2", "ff15:7079:7468:6f6e:6465:6d6f:6d63:6173"):
        arguments: dict[str, Any] = {"interface": "udp_multicast", "port": port, "hop_limit": 0}
        try:
            with can.Bus(group, **arguments) as one, can.Bus(group, **arguments) as other:
                one.send(can.Message(arbitration_id=1))
                if other.recv(10.0) is not None:
                    return group
        except can.CanError as error:
            failed.append(f"{group}: {error}")
    raise RuntimeError(f"no multicast on this computer: {failed}")


class SerialAdapter:
    """An adapter with the slcan protocol on a pseudo-terminal; notes what it is told."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.told = b""
        self._master, slave = os.openpty()
        tty.setraw(slave)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(slave))
        self._slave = slave
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self) -> None:
        while not self._end.is_set():
            if select.select([self._master], [], [], 0.05)[0]:
                self.told += os.read(self._master, 1000)

    def send(self, data: bytes) -> None:
        """Send bytes to the computer."""
        while data:
            data = data[os.write(self._master, data) :]

    def unplug(self) -> None:
        """Take the adapter out; may be called twice."""
        if not self._end.is_set():
            self._end.set()
            self._thread.join()
            self.link.unlink(missing_ok=True)
            os.close(self._slave)
            os.close(self._master)


@contextmanager
def plugged_in(link: Path) -> Iterator[SerialAdapter]:
    """Plug an adapter in, and out at the end."""
    adapter = SerialAdapter(link)
    try:
        yield adapter
    finally:
        adapter.unplug()
