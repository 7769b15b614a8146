"""Pictures of floors: what is taken, what is refused before it is decoded, and what is left of it."""

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from app.blobs import FolderBlobStore
from app.errors import InvalidInput, TooLarge
from app.services.receive_plan import LONGEST_SIDE_PX, Placement, place_plan


def picture(size: tuple[int, int] = (60, 40), mode: str = "RGB") -> Image.Image:
    """White, black in its lower left quarter."""
    image = Image.new("RGBA", size, "white")
    image.paste((0, 0, 0, 255), (0, size[1] // 2, size[0] // 2, size[1]))
    return image.convert(mode)


def encoded(image: Image.Image, format: str = "PNG", **options: Any) -> bytes:
    out = io.BytesIO()
    image.save(out, format, **options)
    return out.getvalue()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, pixels: bytes) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(pixels)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def stored(blobs: FolderBlobStore, data: bytes, metres_per_pixel: float = 0.1) -> tuple[Any, Image.Image]:
    plan = place_plan(blobs, data, Placement(metres_per_pixel))
    return plan, Image.open(io.BytesIO(blobs.get(plan.sha256)))


MODES = {"PNG": ["RGB", "L", "P", "RGBA", "1", "LA"], "JPEG": ["RGB", "L", "CMYK"], "WEBP": ["RGB", "RGBA"]}


@pytest.mark.parametrize(("format", "mode"), [(format, mode) for format in MODES for mode in MODES[format]])
def test_pictures_of_every_kind_keep_their_look(blob_store: FolderBlobStore, format: str, mode: str) -> None:
    data = encoded(picture(mode="RGB").convert(mode), format)
    plan, image = stored(blob_store, data)
    assert plan.media_type == ("image/png" if format == "PNG" else "image/webp")
    assert (plan.width_px, plan.height_px) == image.size == (60, 40)
    assert (plan.width_m, plan.height_m) == pytest.approx((6.0, 4.0))
    shown = np.asarray(image.convert("RGB")).astype(int)
    assert shown[30, 15].max() < 30
    assert shown[10, 45].min() > 225


def test_sixteen_bits_of_grey_are_not_clipped(blob_store: FolderBlobStore) -> None:
    grey = Image.fromarray(np.linspace(0, 65535, 200).astype(np.uint16).reshape(10, 20))
    _, image = stored(blob_store, encoded(grey))
    np.testing.assert_allclose(
        np.asarray(image.convert("L")).ravel(), np.linspace(0, 255, 200).astype(np.uint16), atol=1
    )


def test_transparency_stays(blob_store: FolderBlobStore) -> None:
    image = Image.new("RGBA", (8, 8), (255, 0, 0, 0))
    image.putpixel((3, 3), (255, 0, 0, 255))
    for format, options in (("PNG", {}), ("WEBP", {"lossless": True})):
        _, kept = stored(blob_store, encoded(image, format, **options))
        assert kept.mode == "RGBA"
        alpha = np.asarray(kept)[..., 3]
        assert (alpha[3, 3], alpha[0, 0]) == (255, 0)


def test_nothing_but_pixels_is_kept(blob_store: FolderBlobStore) -> None:
    told = PngImagePlugin.PngInfo()
    told.add_text("Author", "SECRET", zip=False)
    exif = Image.Exif()
    exif[0x010E] = "SECRET"
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for data in (
        encoded(picture(), "PNG", pnginfo=told, exif=exif, icc_profile=profile, dpi=(300, 300)) + b"SECRET",
        encoded(picture(), "JPEG", exif=exif, icc_profile=profile, comment=b"SECRET"),
        encoded(picture(), "WEBP", exif=exif, icc_profile=profile, xmp=b"SECRET"),
    ):
        assert b"SECRET" in data
        plan, image = stored(blob_store, data)
        assert b"SECRET" not in blob_store.get(plan.sha256)
        assert not image.getexif()
        assert not {"icc_profile", "exif", "xmp", "dpi", "Author"} & set(image.info)


def test_a_photograph_is_set_upright(blob_store: FolderBlobStore) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # turn it a quarter clockwise
    plan, image = stored(blob_store, encoded(picture((80, 40)), "JPEG", exif=exif))
    assert image.size == (40, 80)
    assert (plan.width_m, plan.height_m) == pytest.approx((4.0, 8.0))
    assert np.asarray(image.convert("L"))[20, 10] < 30, "the lower left quarter came to the upper left"


@pytest.mark.parametrize(("width", "height"), [(5000, 3000), (1000, 9000), (20_000, 30), (40_000, 16)])
def test_large_pictures_shrink_and_their_metres_stay(blob_store: FolderBlobStore, width: int, height: int) -> None:
    plan, image = stored(blob_store, encoded(picture((width, height), "L")), metres_per_pixel=0.01)
    assert max(image.size) == LONGEST_SIDE_PX
    assert (plan.width_px, plan.height_px) == image.size
    assert (plan.width_m, plan.height_m) == pytest.approx((0.01 * width, 0.01 * height))
    assert plan.metres_per_pixel * max(image.size) == pytest.approx(0.01 * max(width, height))


def test_the_same_picture_is_the_same_blob(blob_store: FolderBlobStore) -> None:
    first, again = (place_plan(blob_store, encoded(picture()), Placement(m)) for m in (0.1, 0.2))
    assert first.sha256 == again.sha256


SVG = b'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg"><script>alert(1)</script></svg>'
FRAMES = [picture(), picture().transpose(Image.Transpose.ROTATE_180)]


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not a PNG, JPEG or WebP"),
        (b"a,b,c\n1,2,3\n", "not a PNG, JPEG or WebP"),
        (SVG, "not a PNG, JPEG or WebP"),
        (b"%PDF-1.7", "not a PNG, JPEG or WebP"),
        (encoded(picture(), "GIF"), "not a PNG, JPEG or WebP"),
        (encoded(picture(), "TIFF"), "not a PNG, JPEG or WebP"),
        (encoded(picture(), "PNG")[:60], "damaged or cut short"),
        (encoded(picture((300, 300)), "JPEG")[:500], "damaged or cut short"),
        (encoded(picture((300, 300)), "WEBP")[:60], "damaged or cut short"),
        (b"\x89PNG\r\n\x1a\n", "damaged or cut short"),
        (b"\xff\xd8\xff" + bytes(50), "damaged or cut short"),
        (b"RIFF\x10\0\0\0WAVEfmt ", "damaged or cut short"),
        (png(0, 5, b""), "damaged or cut short"),
        (png(10, 10, b"\0"), "damaged or cut short"),
        (encoded(FRAMES[0], "PNG", save_all=True, append_images=FRAMES[1:]), "animated, 2 frames"),
        (encoded(FRAMES[0], "WEBP", save_all=True, append_images=FRAMES[1:]), "animated, 2 frames"),
    ],
)
def test_what_is_no_still_picture_is_refused(blob_store: FolderBlobStore, data: bytes, why: str) -> None:
    with pytest.raises(InvalidInput, match=why) as caught:
        place_plan(blob_store, data, Placement(0.1))
    assert caught.value.faults[0].location == "/body"


@pytest.mark.parametrize("side", [6400, 10_000, 60_000])
def test_bombs_are_refused_before_they_are_decoded(
    blob_store: FolderBlobStore, side: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(self: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(PngImagePlugin.PngImageFile, "load", load)
    with pytest.raises(TooLarge, match="40 megapixels"):
        place_plan(blob_store, png(side, side, bytes(1000)), Placement(0.001))


def test_a_bomb_of_text_is_refused(blob_store: FolderBlobStore) -> None:
    bomb = chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(80 * 2**20)))
    data = encoded(picture())
    with pytest.raises(InvalidInput, match="damaged"):
        place_plan(blob_store, data[:33] + bomb + data[33:], Placement(0.1))


def test_a_plan_of_ten_kilometres_is_a_mistake(blob_store: FolderBlobStore) -> None:
    with pytest.raises(InvalidInput, match="metres is one pixel"):
        place_plan(blob_store, encoded(picture((600, 40))), Placement(50.0))
