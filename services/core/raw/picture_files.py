"""PNG and TIFF files of counts.

Both formats may hold pictures that are no counts, so what a file must say is a list, and everything else is refused by
its name. PNG is read by imagecodecs and TIFF by tifffile, because OpenCV returns a part of a truncated PNG without an
error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from services.core.files.image_headers import PNG_SIGNATURE, png_header
from services.core.raw.decoded import Decoded, UnfitError

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPage

_PNG_COLOURS: Mapping[int, str] = MappingProxyType({3: "a palette", 4: "an alpha channel", 6: "an alpha channel"})
"""Codes of the PNG colour types that are no counts; grey and red-green-blue are."""
_TIFF_MEANINGS: Mapping[int, str] = MappingProxyType(
    {
        0: "inverted greys (white is zero)",
        3: "a palette",
        4: "a transparency mask",
        5: "printing inks (CMYK)",
        6: "YCbCr colours",
        8: "CIE Lab colours",
        9: "ICC Lab colours",
        10: "ITU Lab colours",
        32844: "logarithms of luminance",
        32845: "logarithms of luminance and colour",
    }
)
"""Codes of the photometric interpretations that are no counts."""
_GREY, _RGB, _MOSAIC, _LINEAR_RAW = 1, 2, 32803, 34892
_COUNTS = frozenset({_GREY, _RGB, _MOSAIC, _LINEAR_RAW})
_LOSSLESS = frozenset({1, 5, 8, 32773, 32946, 34925, 50000, 50013})
"""Codes of the compressions that keep counts: none, LZW, Deflate, PackBits, LZMA, Zstandard."""
_ALPHA = frozenset({1, 2})
_REDUCED, _OF_SEVERAL, _MASK = 1, 2, 4
_PATTERN_SIZE, _PATTERN, _PLANES = 33421, 33422, 50710
_FILTERS = "RGBCMYW"
"""Letters of the colour filters by their codes in TIFF/EP."""
MAX_PAGES = 1000
"""Largest number of a TIFF's pages that are looked at."""


def read_png(path: Path) -> Decoded:
    """Read a PNG of one or three channels of 8 or 16 bits."""
    import imagecodecs

    content = path.read_bytes()
    header = png_header(content[:64])
    if (meaning := _PNG_COLOURS.get(header.colour)) is not None:
        raise UnfitError(f"has {meaning}, which is no count; export it as plain grey or red, green, blue")
    if header.depth < 8:
        raise UnfitError(f"has {header.depth} bits a count; export it with 8 or 16")
    parts = set(_png_parts(content))
    if b"tRNS" in parts:
        raise UnfitError("has transparent colours; export it without transparency")
    if b"acTL" in parts:
        raise UnfitError("has several pictures; export each as a file of its own")
    values = imagecodecs.png_decode(content)
    channels = 1 if header.colour == 0 else 3
    if values.dtype.itemsize * 8 != header.depth or values.size != header.height * header.width * channels:
        raise UnfitError(f"decodes to {values.shape} numbers of {values.dtype}, not what it declares; export it again")
    return Decoded(values)


def _png_parts(content: bytes) -> Iterator[bytes]:
    place = len(PNG_SIGNATURE)
    while place + 8 <= len(content):
        kind = content[place + 4 : place + 8]
        yield kind
        if kind == b"IEND":
            return
        place += 12 + int.from_bytes(content[place : place + 4], "big")


def read_tiff(path: Path) -> Decoded:
    """Read the only picture of a TIFF; thumbnails beside it are passed over."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = _only_picture(file, path.name)
        _require_counts(page)
        values = page.asarray()
        if values.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            values = np.moveaxis(values, 0, -1)
        return Decoded(values, pattern=filter_pattern(page))


def _only_picture(file: TiffFile, name: str) -> TiffPage:
    pages: list[TiffPage] = []
    for index in range(min(len(file.pages), MAX_PAGES)):
        page = file.pages[index]
        pages.append(page.aspage())  # a later page may be a frame, which takes over the first page's tags
    below = [inner.aspage() for page in pages for inner in page.pages or ()]
    full = [page for page in [*pages, *below] if not int(page.subfiletype) & _REDUCED and not _is_reduced(page)]
    masks = [page for page in full if int(page.subfiletype) & _MASK]
    if not pages:
        raise ValueError("it has no picture")
    if not full:
        raise UnfitError("holds nothing but a picture of reduced size; export the picture itself")
    if masks:
        raise UnfitError("has a page that is a transparency mask; export it without transparency")
    if len(full) > 1 or _hidden_pictures(file, full[0]):
        number = pages.index(full[0]) if full[0] in pages else 0
        many = len(full) if len(full) > 1 else "several"
        raise UnfitError(
            f"has {many} pictures, and which one is meant is not said; extract one, such as by 'tiffcp"
            f' "{name},{number}" one.tif\' of LibTIFF'
        )
    return full[0]


def _is_reduced(page: TiffPage) -> bool:
    """Whether the old tag SubfileType says that the page is a picture of reduced size."""
    tag = page.tags.get(255)
    return tag is not None and tag.value == 2


def _hidden_pictures(file: TiffFile, page: TiffPage) -> bool:
    """Whether more pictures follow the only page's without pages of their own, as ImageJ and tifffile write them."""
    if not (file.is_imagej or file.is_shaped):
        return False
    if file.is_imagej and int((file.imagej_metadata or {}).get("images", 1)) > 1:
        return True
    return any(series.size > page.size for series in file.series if page in list(series.pages))


def _require_counts(page: TiffPage) -> None:
    meaning = page.tags.get(262)
    code = None if meaning is None else int(meaning.value)
    if code is None:
        raise UnfitError("does not say what its numbers mean (tag PhotometricInterpretation); export it again")
    if code not in _COUNTS:
        raise UnfitError(
            f"holds {_TIFF_MEANINGS.get(code, f'numbers of the unknown meaning {code}')}, which are no counts;"
            " export it as plain grey or red, green, blue"
        )
    if int(page.compression) not in _LOSSLESS:
        raise UnfitError(
            f"is compressed with loss or by an unknown method ({_name_of(page.compression)}), so its values are no"
            " counts; export it without"
        )
    if _ALPHA & {int(extra) for extra in page.extrasamples}:
        raise UnfitError("has an alpha channel, which is no count; export it without transparency")
    if code == _RGB and page.samplesperpixel < 3:
        raise UnfitError(f"has {page.samplesperpixel} of the three colours that it declares; export it again")
    if code == _MOSAIC and page.samplesperpixel != 1:
        raise UnfitError(f"is a mosaic with {page.samplesperpixel} numbers a pixel; export the mosaic itself")
    bits = page.tags.get(258)
    if bits is not None and isinstance(bits.value, tuple) and len(set(bits.value)) > 1:
        raise UnfitError("has channels of different numbers of bits; export them with the same")
    _require_whole(page)


def _require_whole(page: TiffPage) -> None:
    """Refuse pages of which some strips or tiles were never written; tifffile would fill them with zeros."""
    expected, offsets, lengths = math.prod(page.chunked), page.dataoffsets, page.databytecounts
    absent = expected - sum(start > 0 and length > 0 for start, length in zip(offsets, lengths, strict=False))
    if absent > 0:
        raise UnfitError(f"lacks {absent} of its {expected} strips or tiles of pixels; copy or export it again")


def filter_pattern(page: TiffPage) -> str | None:
    """Colours of a mosaic's 2 x 2 pixels by a page's tags; None where these do not state them.

    Raises:
        UnfitError: they state another mosaic than a Bayer one.
    """
    if int(page.photometric) != _MOSAIC or (tag := page.tags.get(_PATTERN)) is None:
        return None
    size = page.tags.get(_PATTERN_SIZE)
    rows, columns = (2, 2) if size is None else (int(one) for one in size.value)
    codes = np.frombuffer(tag.value, dtype=np.uint8) if isinstance(tag.value, bytes) else np.atleast_1d(tag.value)
    if rows * columns != len(codes) or not len(codes):
        raise UnfitError("states a colour filter whose size contradicts its length; export it again")
    planes = page.tags.get(_PLANES)
    if planes is not None:  # of a DNG, whose pattern counts its planes
        colours = np.frombuffer(planes.value, np.uint8) if isinstance(planes.value, bytes) else np.ravel(planes.value)
        codes = np.array([colours[code] if code < len(colours) else len(_FILTERS) for code in codes])
    letters = np.array([_FILTERS[code] if code < len(_FILTERS) else "?" for code in codes]).reshape(rows, columns)
    return bayer_pattern(np.tile(letters, (2, 2)))


def bayer_pattern(letters: np.ndarray) -> str:
    """The 2 x 2 letters with which a Bayer mosaic begins.

    Args:
        letters: (H, W) letter of each pixel's colour filter.

    Raises:
        UnfitError: the filters do not repeat after two pixels, or are not two green ones, a red and a blue one.
    """
    if odd := sorted(set(letters.ravel().tolist()) - set("RGB")):
        raise UnfitError(
            f"has colour filters {', '.join(odd)} beside or in place of red, green and blue; export it as linear"
            " colours"
        )
    rows, columns = (_period(letters, axis) for axis in (0, 1))
    if rows > 2 or columns > 2:
        raise UnfitError(
            f"has colour filters that repeat after {columns} x {rows} pixels, and only a Bayer mosaic of 2 x 2 is read;"
            " export it as linear colours"
        )
    block = np.resize(letters[:rows, :columns], (rows, columns))
    pattern = "".join(np.tile(block, (2 // rows, 2 // columns)).ravel())
    if pattern not in {"RGGB", "BGGR", "GRBG", "GBRG"}:
        raise UnfitError(
            f"has colour filters that begin {pattern}, which is no Bayer mosaic; export it as linear colours"
        )
    return pattern


def _period(letters: np.ndarray, axis: int) -> int:
    """Smallest number of pixels along an axis after which the filters repeat; the length where they do not."""
    length = letters.shape[axis]
    along = np.moveaxis(letters, axis, 0)
    for period in range(1, length):
        if np.array_equal(along[period:], along[:-period]):
            return period
    return int(length)


def _name_of(code: object) -> str:
    return str(getattr(code, "name", code))
