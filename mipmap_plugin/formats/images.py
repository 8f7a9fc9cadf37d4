"""Reading, compositing and writing of image files, and of NumPy arrays. Pillow (a dependency of scikit-image) is used nowhere else."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from pathlib import Path
from tokenize import TokenError

import numpy as np
import torch
from PIL import ExifTags, Image
from torch import Tensor

from mipmap_plugin.errors import SceneError, SettingsError, ShapeError, brief
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.nodes import no_file
from mipmap_plugin.limits import check_image

# Pillow's modes for 16-bit gray. It reads 16-bit color as 8 bits, keeping the high byte.
GRAY_16_BIT = ("I;16", "I;16B", "I;16L", "I;16N", "I")

# EXIF orientations that exchange the sides of an image.
QUARTER_TURNS = (5, 6, 7, 8)

# Accepted formats; Pillow also supports formats whose images are programs (EPS).
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "PPM")

# Pixels that fit any machine's memory, and the most pixels per byte of a larger image's file: photographs have fewer than 20.
FEW_PIXELS = 2**24
PIXELS_PER_BYTE = 50

# Bytes per pixel while an image is read: four channels of 8 bits and three of 32.
BYTES_PER_PIXEL = 4 + 12

# Pixels that are composited at a time, in 64 bits each.
TOGETHER = 2**18

# What Pillow raises for a file that is not an image, a damaged one and a damaged PNG chunk.
UNREADABLE = (OSError, SyntaxError, ValueError)

# What NumPy raises for a file that is not an array, or whose header, a line of Python, is damaged.
NO_ARRAY = (OSError, ValueError, TypeError, SyntaxError, TokenError, OverflowError, RecursionError)


def read_image(path: str | Path, background: Sequence[float], least: int | None = None) -> Tensor:
    """A PNG or JPEG file as [H, W, 3] float32 in 0..1; transparency shows `background` (RGB in 0..1).

    `least`: px; a JPEG whose sides are both longer may be read smaller, by a power of two, which saves most of the time of a large one.
    EXIF rotation is not applied: cameras are calibrated on the pixels as they are stored. Raises SceneError, also for more pixels
    than the memory holds, or than a file of that size can have.
    """
    pixels = _pixels(path, least)
    if pixels.dtype != np.uint8:
        return torch.from_numpy(pixels)
    if pixels.shape[2] == 4:
        pixels = composite(pixels, background)
    return torch.from_numpy(pixels.astype(np.float32)).div_(255)


def read_straight(path: str | Path) -> np.ndarray | None:
    """The 8-bit RGBA [H, W, 4] of a file, whose colors are not multiplied by alpha; None for a file without transparency. Raises SceneError."""
    pixels = _pixels(path)
    return pixels if pixels.shape[2] == 4 else None


def read_rgba(path: str | Path) -> np.ndarray:
    """The 8-bit RGBA [H, W, 4] of a file, as it is stored; opaque where it has no transparency. Raises SceneError."""
    pixels = _pixels(path)
    return pixels if pixels.shape[2] == 4 else np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)])


def has_alpha(path: str | Path) -> bool:
    """Whether an image file has transparency, from its header alone. Raises SceneError."""
    with _opened(path) as image:
        return image.mode not in GRAY_16_BIT and image.has_transparency_data


def _pixels(path: str | Path, least: int | None = None) -> np.ndarray:
    """A file's RGB or straight-alpha RGBA in 8 bits, [H, W, 3 or 4]; of 16 bits gray in 0..1, float32 [H, W, 3]. Raises SceneError."""
    with _opened(path) as image:
        _refuse_bomb(Path(path), *image.size)
        if image.mode == "F":  # Pillow would take them for levels of 0 to 255
            raise SceneError(f"{path}: its pixels are floats, which do not say what is white; save it with 8 or 16 bits")
        try:
            if least is not None:
                image.draft(None, (least, least))
            if image.mode in GRAY_16_BIT:
                gray = np.asarray(image).astype(np.float32) / np.float32(65535)
                return np.repeat(gray[..., None], 3, axis=2)
            return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB"))
        except Exception as error:  # a damaged file fails in as many ways as Pillow has decoders
            raise SceneError(f"{path}: the image is damaged ({str(error) or type(error).__name__}); download or export it again") from error


def composite(rgba: np.ndarray, background: Sequence[float]) -> np.ndarray:
    """Composite 8-bit straight-alpha RGBA [H, W, 4] over `background` (RGB in 0..1) to 8-bit RGB [H, W, 3].

    Values are truncated, not rounded, as in graphdeco-inria's Blender reader (scene/dataset_readers.py casts
    0..255 floats to bytes): half-transparent pixels are up to one step darker, opaque ones and black or white background exact.
    The published protocols composite before any resizing, on these 8 bits.
    """
    rgb = np.empty((*rgba.shape[:2], 3), np.uint8)
    rows = max(1, TOGETHER // max(1, rgba.shape[1]))
    for top in range(0, len(rgba), rows):
        part = rgba[top : top + rows] / 255.0
        color, alpha = part[..., :3], part[..., 3:]
        blended = color * alpha + np.asarray(background, dtype=np.float64) * (1 - alpha)
        rgb[top : top + rows] = (blended * 255.0).astype(np.uint8)
    return rgb


def averaged_straight(rgba: np.ndarray, size: tuple[int, int], background: Sequence[float]) -> Tensor:
    """An 8-bit RGBA [H, W, 4], whose size is a whole multiple, as P1 makes it smaller: [*size, 3] in 0..1.

    Colors and alpha are averaged by themselves, truncated to 8 bits, and only then composited. Mip-Splatting halves again and again in
    float32, so this does, too: a mean that is a whole level may come out one lower.
    """
    pixels = rgba.astype(np.float32) / np.float32(255)
    while (down := pixels.shape[0] // size[0]) * (across := pixels.shape[1] // size[1]) > 1:
        if down % 2 == across % 2 == 0:
            down = across = 2
        pixels = pixels.reshape(pixels.shape[0] // down, down, pixels.shape[1] // across, across, 4).mean(axis=(1, 3))
    small = composite((pixels * np.float32(255)).astype(np.uint8), background)
    return torch.from_numpy(small.astype(np.float32)).div_(255)


def pillow_bicubic(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize `image` [H, W, 3] in 0..1 with Pillow's bicubic filter on 8 bits: [*size, 3] in 0..1, multiples of 1/255.

    Differs from the same filter on floats: Pillow rounds and clamps to 8 bits between its two passes and after them.
    """
    height, width = size
    small = Image.fromarray(in_8_bits(image)).resize((width, height), Image.Resampling.BICUBIC)
    return torch.from_numpy(np.asarray(small).astype(np.float32)) / 255


def image_size(path: str | Path) -> tuple[int, int]:
    """(width, height) in px of an image file, from its header alone. Raises SceneError."""
    with _opened(path) as image:
        width, height = image.size
        return width, height


def shown_turned(path: str | Path) -> bool:
    """Whether an image file's EXIF says to show it with its sides exchanged. Raises SceneError."""
    with _opened(path) as image:
        try:
            return image.getexif().get(ExifTags.Base.Orientation) in QUARTER_TURNS
        except Exception:  # damaged EXIF fails in as many ways as there are, and says nothing
            return False


def write_image(path: str | Path, image: Tensor, *, overwrite: bool = False) -> Path:
    """Write `image` [H, W, 3], clamped to 0..1 and rounded to 8 bits, as a PNG file; return its path.

    Atomic: an interrupted write leaves the old file. Raises OutputExists, ShapeError, and SceneError for NaN.
    """
    path = Path(path)
    if image.dim() != 3 or image.shape[2] != 3:
        raise ShapeError(f"image for {path}: expected shape [H, W, 3], got {list(image.shape)}")
    if not image.isfinite().all():
        raise SceneError(f"{path}: the image holds NaN or infinity and is not written; check the render that it came from")
    with new_file(path, overwrite) as temporary:
        Image.fromarray(in_8_bits(image)).save(temporary, format="PNG")
    return path


def png(image: Tensor) -> bytes:
    """The PNG file of an image [H, W, 3], clamped to 0..1 and rounded to 8 bits."""
    file = io.BytesIO()
    Image.fromarray(in_8_bits(image)).save(file, format="PNG", optimize=True)
    return file.getvalue()


def lossless_webp(pixels: np.ndarray) -> bytes:
    """The WebP file of RGBA pixels [H, W, 4] of 8 bits, each as it is, transparent ones too."""
    file = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(file, format="WEBP", lossless=True, exact=True)
    return file.getvalue()


def paletted(image: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """An image [H, W, 3] as numbers of colors, [H, W], and these colors, at most 256, [C, 3] in 0..255; errors are spread over neighbors."""
    quantized = Image.fromarray(in_8_bits(image)).quantize()
    return np.asarray(quantized), np.asarray(quantized.getpalette()).reshape(-1, 3)


def beside_each_other(images: Sequence[Tensor], height: int, gap: int) -> Tensor:
    """Images [h, w, 3] of one size beside each other, `gap` white px apart; small ones are enlarged by whole pixels, up to `height` px."""
    times = max(1, height // images[0].shape[0])
    large = [image.cpu().repeat_interleave(times, 0).repeat_interleave(times, 1) for image in images]
    white = torch.ones(large[0].shape[0], gap, 3)
    return torch.cat([large[0], *(part for image in large[1:] for part in (white, image))], dim=1)


def data_uri(image: Tensor, side: int) -> str:
    """The middle of an image [h, w, 3], at most `side` x `side` px, as the address of a PNG."""
    height, width = image.shape[:2]
    top, left = max(0, (height - side) // 2), max(0, (width - side) // 2)
    return "data:image/png;base64," + base64.b64encode(png(image[top : top + side, left : left + side])).decode("ascii")


def write_array(path: Path, values: Tensor, *, overwrite: bool) -> None:
    """Write `values` as 32-bit floats of NumPy's .npy. Atomic; raises OutputExists, and SceneError for NaN and infinity."""
    if not values.isfinite().all():
        raise SceneError(f"{path}: the values hold NaN or infinity and are not written; check the render that they came from")
    with new_file(path, overwrite) as temporary, temporary.open("wb") as file:
        np.save(file, values.detach().to("cpu", torch.float32).numpy())


def in_8_bits(image: Tensor) -> np.ndarray:
    """An image [H, W, 3], clamped to 0..1 and rounded, as uint8."""
    return (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8).numpy()


def read_array(path: str | Path) -> Tensor:
    """The numbers of a NumPy file, float64. Nothing is unpickled. Raises SceneError."""
    try:
        return torch.from_numpy(np.array(np.load(path, mmap_mode="r", allow_pickle=False), dtype=np.float64))
    except NO_ARRAY as error:
        raise SceneError(f"{path}: is not an array that NumPy reads ({brief(error)}); copy it again") from error


def _refuse_bomb(path: Path, width: int, height: int) -> None:
    pixels, size = width * height, path.stat().st_size
    if pixels > FEW_PIXELS and pixels > PIXELS_PER_BYTE * size:
        raise SceneError(f"{path}: {width:,} x {height:,} px in {size:,} bytes are no photograph; give the image that the camera took")
    try:
        check_image(width, height, bytes_per_pixel=BYTES_PER_PIXEL)
    except SettingsError as error:
        raise SceneError(f"{path}: {error}") from error


def _opened(path: str | Path) -> Image.Image:
    try:
        if trouble := no_file(Path(path)):
            raise SceneError(f"{path}: {trouble}; give a PNG or JPEG file")
        return Image.open(path, formats=FORMATS)
    except SceneError:
        raise
    except FileNotFoundError as error:
        raise SceneError(f"{path}: there is no such image; check the path") from error
    except Image.DecompressionBombError as error:  # from the header alone: Pillow reads no image of more than twice MAX_IMAGE_PIXELS
        raise SceneError(f"{path}: has over {2 * (Image.MAX_IMAGE_PIXELS or 0):,} px, more than a camera takes; give it smaller") from error
    except UNREADABLE as error:
        advice = "give a PNG or JPEG file (or, if it is a Git LFS pointer, run `git lfs pull` where it came from)"
        raise SceneError(f"{path}: is not an image that Pillow reads; {advice}") from error
