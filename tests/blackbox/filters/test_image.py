"""The image filter: every encoding, both versions of ROS, hostile images, and in the recorder."""

from __future__ import annotations

import io
import json
import struct
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_typestore

import amberbox
from amberbox.blackbox.columns.ros1_text import md5sum
from amberbox.blackbox.filters.image import ImageError, ImageFilter
from amberbox.blackbox.robot_folder.folder import load_folder
from amberbox.core.errors import AmberboxError
from amberbox.core.source import ImageOptions, TopicOptions
from amberbox.core.types import Schema, Topic
from amberbox.testing.clock import wait_until
from tests.support.manual_recorder import ManualBox, events, last_counters, own_records

STORES = {"ros1": get_typestore(Stores.ROS1_NOETIC), "cdr": get_typestore(Stores.ROS2_HUMBLE)}
Wire = Literal["ros1", "cdr"]
WIDTH, HEIGHT = 16, 12


def topic_of(wire: Wire, kind: str = "Image") -> Topic:
    name = f"sensor_msgs/msg/{kind}"
    text, _ = STORES[wire].generate_msgdef(name, ros_version=1 if wire == "ros1" else 2)
    if wire == "ros1":
        name = name.replace("/msg/", "/")
    return Topic("/camera", wire, Schema(name, f"{wire.replace('cdr', 'ros2')}msg", text.encode()))


def serialised(wire: Wire, kind: str, **fields: Any) -> bytes:
    store = STORES[wire]
    stamp = store.types["builtin_interfaces/msg/Time"](sec=1_700_000_000, nanosec=5)
    more = {"seq": 7} if wire == "ros1" else {}
    header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="lens_é", **more)
    name = f"sensor_msgs/msg/{kind}"
    write = store.serialize_ros1 if wire == "ros1" else store.serialize_cdr
    return bytes(write(store.types[name](header=header, **fields), name))


def raw_image(wire: Wire, encoding: str, pixels: NDArray[Any], **fields: Any) -> bytes:
    """Make an image whose rows have eight bytes of padding."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    padded = np.pad(rows, ((0, 0), (0, 8)), constant_values=255)
    named = {
        "height": len(pixels), "width": fields.pop("width", pixels.shape[1]), "encoding": encoding,
        "is_bigendian": 0, "step": padded.shape[1], "data": padded.reshape(-1),
    }  # fmt: skip
    return serialised(wire, "Image", **(named | fields))


def read(wire: Wire, message: bytes) -> tuple[Any, Image.Image]:
    """Read a converted image with the libraries of others; header and stamp are those sent."""
    name = "sensor_msgs/msg/CompressedImage"
    store = STORES[wire]
    found: Any = (store.deserialize_ros1 if wire == "ros1" else store.deserialize_cdr)(
        message, name
    )
    stamp = found.header.stamp
    assert (stamp.sec, stamp.nanosec) == (1_700_000_000, 5)
    assert found.header.frame_id == "lens_é" and getattr(found.header, "seq", 7) == 7
    return found, Image.open(io.BytesIO(found.data.tobytes()))


def convert(wire: Wire, message: bytes, kind: str = "Image", **options: Any) -> Any:
    images = ImageFilter(ImageOptions(**({"format": "png"} | options)), topic_of(wire, kind))
    return read(wire, images.convert(message))


RGB = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
RGB[:, : WIDTH // 2] = (200, 100, 40)
RGB[:, WIDTH // 2 :] = (10, 60, 250)
GREY = RGB[:, :, 1].copy()


def bayer(pattern: str) -> NDArray[np.uint8]:
    mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = RGB[row::2, column::2, "rgb".index(colour)]
    return mosaic


def yuv(order: str) -> NDArray[np.uint8]:
    bands = dict(zip("yuv", Image.fromarray(RGB).convert("YCbCr").split(), strict=True))
    pairs = np.zeros((HEIGHT, WIDTH, 2), np.uint8)
    for place, band in enumerate(order):  # the four bytes of two pixels
        column = place // 2
        pairs[:, column::2, place % 2] = np.asarray(bands[band])[:, column::2]
    return pairs


COLOURS: dict[str, NDArray[np.uint8]] = {
    "rgb8": RGB,
    "bgr8": RGB[:, :, ::-1],
    "8UC3": RGB[:, :, ::-1],
    "rgba8": np.dstack((RGB, np.full((HEIGHT, WIDTH), 255, np.uint8))),
    "bgra8": np.dstack((RGB[:, :, ::-1], np.full((HEIGHT, WIDTH), 255, np.uint8))),
    **{f"bayer_{p}8": bayer(p) for p in ("rggb", "bggr", "gbrg", "grbg")},
    **dict.fromkeys(("yuv422", "uyvy"), yuv("uyvy")),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), yuv("yuyv")),
}


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@pytest.mark.parametrize("encoding", COLOURS)
def test_colours_stay_what_they_were(wire: Wire, encoding: str) -> None:
    pixels = COLOURS[encoding]
    found, image = convert(wire, raw_image(wire, encoding, pixels), scale=0.5)
    assert image.size == (WIDTH // 2, HEIGHT // 2)
    assert found.format == f"{encoding}; png compressed bgr8"
    np.testing.assert_allclose(
        np.asarray(image.convert("RGB"), int), RGB[::2, ::2].astype(int), atol=3
    )


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
def test_grey_becomes_jpeg_of_its_size(wire: Wire) -> None:
    found, image = convert(wire, raw_image(wire, "mono8", GREY), format="jpeg", quality=95)
    assert (image.format, image.mode, image.size) == ("JPEG", "L", (WIDTH, HEIGHT))
    assert found.format == "mono8; jpeg compressed mono8"
    np.testing.assert_allclose(np.asarray(image, int), GREY, atol=8)


@pytest.mark.parametrize(("encoding", "order"), [("mono16", "<"), ("16UC1", ">")])
def test_16_bits_stay_exact(encoding: str, order: str) -> None:
    pixels = np.arange(WIDTH * HEIGHT, dtype=f"{order}u2").reshape(HEIGHT, WIDTH) * 300
    message = raw_image("cdr", encoding, pixels.astype(f"{order}u2"), is_bigendian=order == ">")
    found, image = convert("cdr", message, scale=0.5, format="jpeg")
    assert found.format == f"{encoding}; png compressed {encoding}"
    np.testing.assert_array_equal(np.asarray(image), pixels[::2, ::2])


def test_distances_in_metres_become_millimetres() -> None:
    metres = np.array([[0.5, np.nan, np.inf, -1.0, 70.0, 1.2345]], np.float32)
    found, image = convert("ros1", raw_image("ros1", "32FC1", metres))
    assert found.format == "32FC1; png compressed 16UC1"
    assert np.asarray(image).tolist() == [[500, 0, 0, 0, 0, 1234]]


@pytest.mark.parametrize("form", ["JPEG", "PNG"])
def test_compressed_images_are_scaled(form: str) -> None:
    out = io.BytesIO()
    Image.fromarray(np.kron(RGB, np.ones((8, 8, 1), np.uint8))).save(out, form)
    data = np.frombuffer(out.getvalue(), np.uint8)
    message = serialised("cdr", "CompressedImage", format=f"rgb8; {form} compressed", data=data)
    found, image = convert("cdr", message, "CompressedImage", scale=0.125, format="jpeg")
    assert (image.format, image.size) == ("JPEG", (WIDTH, HEIGHT))
    assert found.format == "rgb8; jpeg compressed bgr8"
    deep = io.BytesIO()
    depth = np.arange(64, dtype="<u2").reshape(8, 8) * 1000
    Image.frombuffer("I;16", (8, 8), depth.tobytes(), "raw", "I;16", 0, 1).save(deep, "PNG")
    message = serialised(
        "cdr", "CompressedImage", format="16UC1; png", data=np.frombuffer(deep.getvalue(), np.uint8)
    )
    found, image = convert("cdr", message, "CompressedImage", scale=0.5)
    np.testing.assert_array_equal(np.asarray(image), depth[::2, ::2])


BIG = struct.pack(">I", 0xFFFFFFFF)


@pytest.mark.parametrize("wire", ["ros1", "cdr"])
@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"encoding": "32SC4"}, "encoding is '32SC4'"),
        ({"encoding": "x" * 500}, "encoding is"),
        ({"height": 4_000_000_000}, "pixels"),
        ({"width": 0}, "pixels"),
        ({"height": 60_000, "width": 60_000}, "million pixels"),
        ({"height": 13}, "are not in"),
        ({"step": 3}, "are not in"),
        ({"encoding": "yuv422", "width": 15}, "odd width"),
        ({"encoding": "bayer_rggb8", "height": 1}, "smaller than"),
    ],
)
def test_what_cannot_be_converted_is_told(wire: Wire, fields: dict[str, Any], why: str) -> None:
    images = ImageFilter(ImageOptions(), topic_of(wire))
    with pytest.raises(ImageError, match=why):
        images.convert(raw_image(wire, **({"encoding": "rgb8", "pixels": RGB} | fields)))


def test_damaged_messages_raise_nothing_else() -> None:
    rng = np.random.default_rng(5)
    good = raw_image("cdr", "rgb8", RGB)
    out = io.BytesIO()
    Image.fromarray(RGB).save(out, "PNG")
    packed = serialised(
        "cdr", "CompressedImage", format="png", data=np.frombuffer(out.getvalue(), np.uint8)
    )
    refused = 0
    for kind, message in (("Image", good), ("CompressedImage", packed)):
        images = ImageFilter(ImageOptions(), topic_of("cdr", kind))
        for _ in range(400):
            damaged = bytearray(message[: rng.integers(len(message) + 1)])
            for place in rng.integers(0, max(len(damaged), 1), 3).tolist():
                damaged[place : place + 1] = rng.bytes(1)
            try:
                images.convert(bytes(damaged))
            except ImageError:
                refused += 1
    assert refused > 400


def test_the_definition_is_that_of_ros() -> None:
    topic = ImageFilter(ImageOptions(), topic_of("ros1")).topic
    assert topic.schema is not None and topic.schema.name == "sensor_msgs/CompressedImage"
    assert md5sum(topic.schema) == "8f7a12909da2c9d3332d540a0977563f"


def test_other_types_and_a_missing_pillow_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    for other in (
        Topic("/t", "ros1", Schema("a/Image", "ros1msg", b"")),
        Topic("/t", "json", Schema("sensor_msgs/Image", "jsonschema", b"{}")),
        Topic("/t", "cdr"),
    ):
        with pytest.raises(AmberboxError, match="no sensor_msgs/Image"):
            ImageFilter(ImageOptions(), other)
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    with pytest.raises(AmberboxError, match="not installed") as caught:
        ImageFilter(ImageOptions(), topic_of("ros1"))
    assert "amberbox[images]" in caught.value.hint


def box_with(store: Path, **options: Any) -> ManualBox:
    topics = [TopicOptions("/camera", image=ImageOptions(scale=0.5, format="png"), **options)]
    return ManualBox(store, topics)


def test_the_recorder_converts_before_the_journal_and_says_so(tmp_path: Path) -> None:
    box = box_with(tmp_path / "store", max_frequency=10.0)
    image = raw_image("ros1", "rgb8", RGB)
    for _ in range(40):  # 20 Hz
        box.hear(topic_of("ros1"), image)
        wait_until(lambda: not any(c.is_busy for c in box.sink._converters.values()))
        box.write(0.05)
    box.hear(topic_of("ros1"), raw_image("ros1", "32SC4", RGB))
    box.hear(topic_of("ros1"), raw_image("ros1", "32SC4", RGB))
    box.sink.finish()
    box.write()
    box.close()
    counters = last_counters(tmp_path / "store")["ros_camera"]
    assert counters["received"] == 42 and counters["dropped"] == 0
    assert counters["kept"] == counters["received"] - counters["rate_limited"] <= 33
    assert len(events(tmp_path / "store", "image_kept")) == 1
    (run,) = own_records(tmp_path / "store", "amberbox/run")
    assert json.loads(run["items"])["ros_camera"]["image"]["scale"] == 0.5
    with amberbox.open(tmp_path / "store") as record:
        table = record.query("ros_camera", ["format", "data", "encoding"])
    formats = table["format"].tolist()  # type: ignore[union-attr]  # an array
    assert "rgb8; png compressed bgr8" in formats
    assert table["timestamp"].tolist()[0] == 1_700_000_000_000_000_005  # type: ignore[union-attr]  # an array


def test_images_that_come_too_fast_are_dropped_and_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_with(tmp_path / "store")
    entered, leave = threading.Event(), threading.Event()
    original: Callable[[ImageFilter, bytes], bytes] = ImageFilter.convert

    def slow(self: ImageFilter, message: bytes) -> bytes:
        entered.set()
        leave.wait()
        return original(self, message)

    monkeypatch.setattr(ImageFilter, "convert", slow)
    image = raw_image("ros1", "rgb8", RGB)
    box.hear(topic_of("ros1"), image)
    entered.wait()
    box.hear(topic_of("ros1"), *[image] * 9)
    leave.set()
    box.sink.finish()
    box.write()
    box.close()
    counters = last_counters(tmp_path / "store")["ros_camera"]
    assert (counters["received"], counters["kept"], counters["dropped"]) == (10, 4, 6)
    with amberbox.open(tmp_path / "store") as record:
        (gap,) = [gap for gap in record.gaps("ros_camera") if "converted" in gap.reason]
        assert gap.count == 6


def test_images_keep_their_time_of_receipt_and_the_record_waits_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = box_with(tmp_path / "store")
    leave = threading.Event()
    original: Callable[[ImageFilter, bytes], bytes] = ImageFilter.convert

    def slow(self: ImageFilter, message: bytes) -> bytes:
        leave.wait()
        return original(self, message)

    monkeypatch.setattr(ImageFilter, "convert", slow)
    box.sink.topic(topic_of("ros1"))
    for _ in range(2):  # the file that states how late rows may be has begun
        box.write()
    box.clock.advance(0.01)
    received_ns = box.sink.now_ns()
    box.hear(topic_of("ros1"), raw_image("ros1", "rgb8", RGB))
    for _ in range(4):
        box.write(0.1)
    assert box.pipeline.watermark.at_ns < received_ns
    leave.set()
    box.sink.finish()
    box.write(0.1)
    box.close()
    with amberbox.open(tmp_path / "store") as record:
        assert record.query("ros_camera", ["received"]).values("received") == [received_ns]
    assert not events(tmp_path / "store", "late")


def test_options_are_checked(tmp_path: Path) -> None:
    (tmp_path / "robot.yaml").write_text("id: r\n")
    (tmp_path / "black_box.yaml").write_text(
        "- ros: {topics: [{name: /c, image: {scale: 2, quality: 0, format: gif}}]}\n"
    )
    with pytest.raises(AmberboxError) as caught:
        load_folder(tmp_path)
    text = str(caught.value)
    assert "scale" in text or "format" in text
