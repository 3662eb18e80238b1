"""Scale and compress images: an Image or CompressedImage of ROS becomes a smaller CompressedImage.

Header and stamp stay as they were. 16 bit images become PNG, which loses nothing, and are scaled by
leaving pixels out, since mixed distances of a depth camera are no distances; 32 bit distances in
metres become 16 bit millimetres (REP 118). Bayer patterns become colours of half the resolution.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from amberbox.core.errors import AmberboxError
from amberbox.core.source import ImageOptions
from amberbox.core.types import Schema, Topic

if TYPE_CHECKING:
    import PIL.Image
    from PIL.Image import Image

MOST_PIXELS = 1 << 26
_LONGEST_SIDE = 65_500  # of a JPEG
_READ = ("JPEG", "PNG", "WEBP")

_SEPARATOR = "=" * 80 + "\n"
_COMPRESSED_IMAGE = "std_msgs/Header header\nstring format\nuint8[] data\n"
_HEADERS = {
    "ros1": "uint32 seq\ntime stamp\nstring frame_id\n",
    "cdr": f"builtin_interfaces/Time stamp\nstring frame_id\n{_SEPARATOR}"
    "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
}
_SCHEMA_ENCODINGS = {"ros1": "ros1msg", "cdr": "ros2msg"}
_KINDS = ("Image", "CompressedImage")


class ImageError(Exception):
    """An image that cannot be converted, and why."""


class ImageFilter:
    """Converts the images of one topic; ``topic`` is that of the converted ones.

    Raises AmberboxError for a topic without images of ROS, or when Pillow is missing.
    """

    def __init__(self, options: ImageOptions, topic: Topic) -> None:
        package, _, kind = (topic.schema.name if topic.schema else "").rpartition("/")
        encoding = topic.message_encoding
        is_image = package in ("sensor_msgs", "sensor_msgs/msg") and kind in _KINDS
        if not is_image or encoding not in _HEADERS:
            what = topic.schema.name if topic.schema else "messages without a type"
            raise AmberboxError(
                f"{what} in {encoding} is no sensor_msgs/Image or CompressedImage of ROS",
                "leave out 'image:' of this topic",
            )
        try:
            import PIL.Image  # noqa: F401  # found missing here, not with the first image
        except ImportError as error:
            raise AmberboxError(
                "images are converted with Pillow, which is not installed",
                "pip install 'amberbox[images]'",
            ) from error
        self._options = options
        self._encoding = encoding
        self._decode = _raw_image if kind == "Image" else _compressed_image
        text = f"{_COMPRESSED_IMAGE}{_SEPARATOR}MSG: std_msgs/Header\n{_HEADERS[encoding]}"
        name = f"{package}/CompressedImage"
        schema = Schema(name, _SCHEMA_ENCODINGS[encoding], text.encode())
        self.topic = Topic(topic.name, encoding, schema, topic.latched)

    @property
    def note(self) -> str:
        """Return what is done to the images, in one line."""
        options = self._options
        quality = f" of quality {options.quality}" if options.format == "jpeg" else ""
        return f"scaled to {options.scale:g}, {options.format}{quality}"

    def convert(self, message: bytes) -> bytes:
        """Return a message with the converted image; raises ImageError if that is impossible."""
        try:
            reader = _Reader(message, self._encoding == "cdr")
            header = _header(reader)
            picture = self._decode(reader, self._options.scale)
            data = _encoded(picture.image, self._options)
        except ImageError:
            raise
        except Exception as error:  # images come from anybody, and Pillow raises many kinds
            raise ImageError(f"{type(error).__name__}: {error}"[:200]) from error
        form = "png" if picture.image.mode.startswith("I;16") else self._options.format
        text = f"{picture.encoding}; {form} compressed {picture.target}"
        return _message(self._encoding == "cdr", header, text, data)


@dataclass(slots=True)
class _Reader:
    """Reads fields of a serialised message in order."""

    data: bytes
    cdr: bool
    order: str = "<"
    at: int = 0
    origin: int = 0

    def __post_init__(self) -> None:
        if self.cdr:
            if self.data[:2] not in (b"\x00\x00", b"\x00\x01"):
                raise ImageError("it is not plain CDR")
            self.order = "<" if self.data[1] else ">"
            self.at = self.origin = 4

    def number(self, kind: str = "I") -> int:
        size = struct.calcsize(kind)
        if self.cdr:
            self.at += (self.origin - self.at) % size
        (value,) = struct.unpack_from(self.order + kind, self.data, self.at)
        self.at += size
        return int(value)

    def blob(self) -> memoryview:
        size = self.number()
        self.at += size
        if self.at > len(self.data):
            raise ImageError("it is shorter than it claims")
        return memoryview(self.data)[self.at - size : self.at]

    def text(self) -> str:
        return bytes(self.blob()).rstrip(b"\0").decode("utf-8", "replace")


@dataclass(frozen=True, slots=True)
class _Header:
    seq: int
    seconds: int
    nanoseconds: int
    frame_id: str


def _header(reader: _Reader) -> _Header:
    seq = 0 if reader.cdr else reader.number()
    return _Header(seq, reader.number(), reader.number(), reader.text())


def _message(cdr: bool, header: _Header, form: str, data: bytes) -> bytes:
    stamp = struct.pack("<II", header.seconds, header.nanoseconds)
    size = struct.pack("<I", len(data))
    if not cdr:
        texts = b"".join(
            struct.pack("<I", len(text)) + text
            for text in (header.frame_id.encode(), form.encode())
        )
        return struct.pack("<I", header.seq) + stamp + texts + size + data
    message = bytearray(b"\x00\x01\x00\x00" + stamp)
    for text in (header.frame_id.encode() + b"\0", form.encode() + b"\0"):
        message += struct.pack("<I", len(text)) + text
        message += bytes(-len(message) % 4)
    return bytes(message) + size + data


@dataclass(frozen=True, slots=True)
class _Picture:
    """A scaled image, the encoding it had, and the one it has now."""

    image: Image
    encoding: str
    target: str


# mode and raw mode of Pillow, bytes per pixel
_PLAIN: Mapping[str, tuple[str, str, int]] = {
    "rgb8": ("RGB", "RGB", 3),
    "bgr8": ("RGB", "BGR", 3),
    "8UC3": ("RGB", "BGR", 3),
    "rgba8": ("RGBA", "RGBA", 4),
    "bgra8": ("RGBA", "BGRA", 4),
    "8UC4": ("RGBA", "BGRA", 4),
    "mono8": ("L", "L", 1),
    "8UC1": ("L", "L", 1),
}
_DEPTHS = {"mono16": "<u2", "16UC1": "<u2", "32FC1": "<f4"}
# where red, the two greens and blue are in two rows of two pixels
_BAYER = {"rggb": (0, 1, 2, 3), "bggr": (3, 1, 2, 0), "gbrg": (2, 0, 3, 1), "grbg": (1, 0, 3, 2)}
_BAYER_ENCODINGS = {f"bayer_{pattern}8": places for pattern, places in _BAYER.items()}
# where the two brightnesses and the two colours are in two pixels
_YUV = {
    **dict.fromkeys(("yuv422", "uyvy"), (1, 3, 0, 2)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (0, 2, 1, 3)),
}


def _raw_image(reader: _Reader, scale: float) -> _Picture:
    from PIL import Image

    height, width, encoding = reader.number(), reader.number(), reader.text()
    big_endian, step, data = reader.number("B") != 0, reader.number(), reader.blob()
    _check_size(width, height)
    size = scaled_size(width, height, scale)
    if encoding in _PLAIN:
        mode, raw, width_bytes = _PLAIN[encoding]
        _check_rows(data, width * width_bytes, step, height)
        pixel_rows: Any = data  # Pillow takes any buffer
        image = Image.frombuffer(mode, (width, height), pixel_rows, "raw", raw, step, 1)
        if image.mode == "RGBA":
            image = image.convert("RGB")
        return _Picture(_scaled(image, size), encoding, _target(image.mode))
    if encoding in _DEPTHS:
        kind = np.dtype(_DEPTHS[encoding]).newbyteorder(">" if big_endian else "<")
        pixels = _rows(data, width * kind.itemsize, step, height).view(kind)
        rows, columns = (
            np.arange(new) * old // new
            for new, old in zip(size[::-1], (height, width), strict=True)
        )
        image = _image16(_millimetres(pixels[np.ix_(rows, columns)]))
        return _Picture(image, encoding, "16UC1" if encoding == "32FC1" else encoding)
    if encoding in _BAYER_ENCODINGS:
        image = _from_bayer(_rows(data, width, step, height), _BAYER_ENCODINGS[encoding])
        return _Picture(_scaled(image, size), encoding, "bgr8")
    if encoding in _YUV:
        image = _from_yuv(_rows(data, width * 2, step, height), _YUV[encoding])
        return _Picture(_scaled(image, size), encoding, "bgr8")
    raise ImageError(f"its encoding is {encoding[:40]!r}")


def _compressed_image(reader: _Reader, scale: float) -> _Picture:
    from PIL import Image

    form, data = reader.text(), reader.blob()
    image: PIL.Image.Image = Image.open(io.BytesIO(data), formats=_READ)
    _check_size(*image.size)
    size = scaled_size(*image.size, scale)
    encoding = form.partition(";")[0].strip() or str(image.format).lower()
    if image.mode.startswith("I"):  # Pillow reads 16 bit PNG as I;16, or as I before version 12
        depth = _image16(_thinned(np.asarray(image), size).astype(np.uint16))
        return _Picture(depth, encoding, "mono16" if encoding == "mono16" else "16UC1")
    image.draft("RGB" if image.mode != "L" else "L", size)
    if image.mode not in ("L", "RGB"):
        image = image.convert("RGB")
    return _Picture(_scaled(image, size), encoding, _target(image.mode))


def _check_size(width: int, height: int) -> None:
    if not (0 < width <= _LONGEST_SIDE and 0 < height <= _LONGEST_SIDE):
        raise ImageError(f"it is {width} x {height} pixels")
    if width * height > MOST_PIXELS:
        raise ImageError(f"it has more than {MOST_PIXELS >> 20} million pixels")


def _check_rows(data: memoryview, width_bytes: int, step: int, height: int) -> None:
    if step < width_bytes or step * height > len(data):
        raise ImageError(f"{height} rows of {step} bytes are not in {len(data)} bytes")


def _rows(data: memoryview, width_bytes: int, step: int, height: int) -> NDArray[np.uint8]:
    """Return the rows of an image without the padding behind them."""
    _check_rows(data, width_bytes, step, height)
    padded = np.frombuffer(data, np.uint8, step * height).reshape(height, step)
    return np.ascontiguousarray(padded[:, :width_bytes])


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Return width and height of a scaled image: at least one pixel."""
    return max(1, round(width * scale)), max(1, round(height * scale))


def _scaled(image: Image, size: tuple[int, int]) -> Image:
    from PIL.Image import Resampling

    return image if image.size == size else image.resize(size, Resampling.BOX)


def _thinned(pixels: NDArray[Any], size: tuple[int, int]) -> NDArray[Any]:
    """Leave out rows and columns until an image has this width and height."""
    height, width = pixels.shape
    rows, columns = np.arange(size[1]) * height // size[1], np.arange(size[0]) * width // size[0]
    return pixels[np.ix_(rows, columns)]


def _target(mode: str) -> str:
    return "mono8" if mode == "L" else "bgr8"


def _millimetres(pixels: NDArray[Any]) -> NDArray[np.uint16]:
    """Return 16 bit numbers; distances in metres as millimetres, 0 where there is none."""
    if pixels.dtype.kind != "f":
        return pixels.astype(np.uint16)
    with np.errstate(invalid="ignore", over="ignore"):
        distances = np.rint(pixels.astype(np.float32) * 1000)
        known = np.isfinite(distances) & (distances > 0) & (distances < 65_536)
        return np.where(known, distances, 0).astype(np.uint16)


def _image16(pixels: NDArray[np.uint16]) -> Image:
    from PIL import Image

    data = np.ascontiguousarray(pixels, "<u2").tobytes()
    return Image.frombuffer("I;16", pixels.shape[::-1], data, "raw", "I;16", 0, 1)


def _from_bayer(pixels: NDArray[np.uint8], places: tuple[int, int, int, int]) -> Image:
    """Return the colours of each square of four pixels."""
    from PIL import Image

    height, width = pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2
    if not height or not width:
        raise ImageError("it is smaller than a Bayer pattern")
    squares = [pixels[row:height:2, column:width:2] for row in (0, 1) for column in (0, 1)]
    red, green, green2, blue = (squares[place] for place in places)
    mean = ((green.astype(np.uint16) + green2) // 2).astype(np.uint8)
    return Image.fromarray(np.stack((red, mean, blue), axis=2))


def _from_yuv(pixels: NDArray[np.uint8], places: tuple[int, int, int, int]) -> Image:
    """Return an image of pairs of pixels that share their colour."""
    from PIL import Image

    if pixels.shape[1] % 4:
        raise ImageError("it has an odd width")
    pairs = pixels.reshape(pixels.shape[0], -1, 4)
    bright = pairs[:, :, places[:2]].reshape(pixels.shape[0], -1)
    colours = (np.repeat(pairs[:, :, place], 2, axis=1) for place in places[2:])
    bands = np.stack((bright, *colours), axis=2)
    size = bright.shape[::-1]
    return Image.frombuffer("YCbCr", size, bands.tobytes(), "raw", "YCbCr", 0, 1).convert("RGB")


def _encoded(image: Image, options: ImageOptions) -> bytes:
    out = io.BytesIO()
    if image.mode.startswith("I;16") or options.format == "png":
        image.save(out, "PNG", compress_level=1)
    else:
        image.save(out, "JPEG", quality=options.quality)
    return out.getvalue()
