"""Whether the packets of a video are whole, told by their framing, without decoding a picture.

H.264 and HEVC in MP4 are units, each after its length; AV1 is OBUs, which hold theirs. The lengths
must fill the packet exactly, and a bit at the head of each must be 0. What overwrote a part of the
file (a block of zeros, of another file) breaks that in nearly every packet that it holds the head
of. A bit that flipped inside a picture does not: only decoding tells that.
"""

from __future__ import annotations

from collections.abc import Callable

_LENGTH = 4
"""Bytes of a unit's length, as every encoder that LeRobot uses writes it."""
_OBU_EXTENDED, _OBU_SIZED = 0x04, 0x02
_OBU_KINDS = (1, 2, 3, 4, 5, 6, 7, 8, 15)
"""All that are defined; others are reserved."""
_OBU_PICTURES = (4, 6)
"""Kinds that end a packet: tiles, and a whole picture. The last OBU may go without a length."""


def find_framing(codec: str, extradata: bytes | None) -> Callable[[bytes], bool] | None:
    """Return what tells whether a packet is whole; None where that cannot be told.

    Args:
        codec: Name of the codec, as FFmpeg has it.
        extradata: The codec's head in the file.
    """
    if codec == "av1":
        return is_whole_av1
    if codec in ("h264", "hevc") and extradata and extradata[0] == 1:  # avcC, hvcC
        place = 4 if codec == "h264" else 21
        if len(extradata) > place and (extradata[place] & 3) + 1 == _LENGTH:
            return is_whole_nal
    return None


def is_whole_nal(packet: bytes) -> bool:
    """Whether a packet is units of H.264 or HEVC, each after its length of four bytes."""
    place, end = 0, len(packet)
    while place + _LENGTH < end:
        length = int.from_bytes(packet[place : place + _LENGTH], "big")
        if not length or packet[place + _LENGTH] & 0x80:
            return False
        place += _LENGTH + length
    return place == end and end > 0


def is_whole_av1(packet: bytes) -> bool:
    """Whether a packet is OBUs of AV1, the last of which may go without a length."""
    place, end = 0, len(packet)
    while place < end:
        head = packet[place]
        kind = head >> 3 & 15
        if head & 0x81 or kind not in _OBU_KINDS:  # the forbidden and the reserved bit
            return False
        place += 2 if head & _OBU_EXTENDED else 1
        if not head & _OBU_SIZED:
            return kind in _OBU_PICTURES and place < end
        length, shift = 0, 0
        while True:
            if place >= end or shift > 49:  # at most eight bytes
                return False
            byte = packet[place]
            length |= (byte & 0x7F) << shift
            place, shift = place + 1, shift + 7
            if not byte & 0x80:
                break
        place += length
    return place == end and end > 0
