"""PNG files around any bytes, whatever their headers say of them."""

import struct
import zlib


def chunk(name: bytes, data: bytes) -> bytes:
    body = name + data
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


def png_around(
    packed: bytes, width: int, height: int, kind: int = 2, interlace: int = 0, piece: int = 1 << 20
) -> bytes:
    """Checksums are right. kind: the colour type; piece: bytes of a chunk of pixels."""
    parts = [chunk(b"IDAT", packed[k : k + piece]) for k in range(0, len(packed), piece)]
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, interlace))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(parts) + chunk(b"IEND", b"")
