"""Receive a floor plan: check a picture before it is decoded, make a clean copy of it, keep that under its SHA-256.

What is stored is never the file that was sent but its pixels, written anew: no metadata, no profiles, nothing a viewer
of pictures might stumble over. Order of durability: the blob is on disk before the row that names it.
"""

import io
from collections.abc import Callable
from dataclasses import asdict, dataclass
from math import hypot
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from app.blobs import BlobStore
from app.errors import Fault, InvalidInput, TooLarge

__all__ = ["LONGEST_SIDE_PX", "MAX_PIXELS", "MAX_PLAN_BYTES", "Picture", "Placement", "Plan", "place_plan", "redraw"]

MAX_PLAN_BYTES = 20 * 2**20
MAX_PIXELS = 40_000_000
LONGEST_SIDE_PX = 4096
FARTHEST_M = 10_000.0
MAGIC = {"PNG": b"\x89PNG\r\n\x1a\n", "JPEG": b"\xff\xd8\xff", "WEBP": b"RIFF"}
QUALITY = 90  # of WebP; a PNG stays free of loss


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture drawn anew: its bytes and size in pixels, and that of the picture which was sent."""

    encoded: bytes
    media_type: str
    width_px: int
    height_px: int
    sent_px: tuple[int, int]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a picture lies: building x, y of its lower left corner in m; its x axis counter-clockwise from x in rad."""

    metres_per_pixel: float
    x_m: float = 0.0
    y_m: float = 0.0
    bearing_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Plan:
    """A stored plan, as the floor's row has it. The sides in metres are those of the picture that was sent."""

    sha256: str
    media_type: str
    width_px: int
    height_px: int
    width_m: float
    height_m: float
    metres_per_pixel: float
    x_m: float
    y_m: float
    bearing_rad: float

    def as_row(self) -> dict[str, Any]:
        return asdict(self)


def redraw(data: bytes) -> Picture:
    """The pixels of a PNG, JPEG or WebP picture, written anew; some hundred megabytes of memory for a moment.

    Raises InvalidInput for bytes that are no such picture, are damaged or animated; TooLarge for more pixels than the
    limit, before they are decoded.
    """
    image = _decode(data)
    small = _shrunk(image)
    media_type = "image/png" if data.startswith(MAGIC["PNG"]) else "image/webp"
    return Picture(_encode(small, media_type), media_type, small.width, small.height, image.size)


def place_plan(
    blobs: BlobStore, data: bytes, placement: Placement, redraw: Callable[[bytes], Picture] = redraw
) -> Plan:
    """Check and store a picture of a floor. Raises as `redraw`, and InvalidInput for one that would lie absurdly; then
    nothing is stored."""
    picture = redraw(data)
    width_m, height_m = (placement.metres_per_pixel * side for side in picture.sent_px)
    _check_size(width_m, height_m)
    return Plan(
        sha256=blobs.put(picture.encoded),
        media_type=picture.media_type,
        width_px=picture.width_px,
        height_px=picture.height_px,
        width_m=width_m,
        height_m=height_m,
        metres_per_pixel=max(width_m, height_m) / max(picture.width_px, picture.height_px),
        x_m=placement.x_m,
        y_m=placement.y_m,
        bearing_rad=placement.bearing_rad,
    )


def _decode(data: bytes) -> Image.Image:
    """The upright picture as RGB or RGBA."""
    kinds = [kind for kind, magic in MAGIC.items() if data.startswith(magic)]
    if not kinds:
        raise _refused("the body is not a PNG, JPEG or WebP picture; vector drawings are to be exported as PNG first")
    try:
        with Image.open(io.BytesIO(data), formats=kinds) as image:
            _check_header(image)
            image.load()
            return _clean(ImageOps.exif_transpose(image))
    except (InvalidInput, TooLarge):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise _too_many_pixels() from None
    except MemoryError:
        raise
    except Exception as error:  # the readers raise whatever they stumble over: OSError, SyntaxError, struct.error ...
        raise _refused(f"the {kinds[0]} picture is damaged or cut short: {ascii(str(error))[:120]}") from error


def _check_header(image: Image.Image) -> None:
    if image.width * image.height > MAX_PIXELS:
        raise _too_many_pixels()
    frames = getattr(image, "n_frames", 1)
    if image.format in ("PNG", "WEBP") and frames > 1:  # a JPEG's others are thumbnails and depths of its first
        raise _refused(f"the picture is animated, {frames} frames; send one")


def _clean(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):  # 16-bit grey, which `convert` would clip
        image = Image.fromarray((np.asarray(image).astype(np.uint32) >> 8).astype(np.uint8))
    clean = image.convert("RGBA" if image.has_transparency_data else "RGB")
    clean.info = {}
    return clean


def _check_size(width_m: float, height_m: float) -> None:
    if hypot(width_m, height_m) > FARTHEST_M:
        reason = f"the plan would be {width_m:,.0f} m by {height_m:,.0f} m: how many metres is one pixel wide?"
        raise InvalidInput(reason, Fault("/query/metres_per_pixel", reason))


def _shrunk(image: Image.Image) -> Image.Image:
    scale = LONGEST_SIDE_PX / max(image.size)
    if scale >= 1.0:
        return image
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.BOX if scale < 0.5 else Image.Resampling.LANCZOS)


def _encode(image: Image.Image, media_type: str) -> bytes:
    out = io.BytesIO()
    if media_type == "image/png":
        image.save(out, "PNG")
    else:
        image.save(out, "WEBP", quality=QUALITY)
    return out.getvalue()


def _refused(reason: str) -> InvalidInput:
    return InvalidInput(reason, Fault("/body", reason))


def _too_many_pixels() -> TooLarge:
    return TooLarge(f"a plan may have {MAX_PIXELS / 1e6:g} megapixels, this one has more; send it smaller")
