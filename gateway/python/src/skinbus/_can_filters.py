"""Filters of python-can in the form of the server of an embedded bus."""

from __future__ import annotations

import struct
from collections.abc import Collection
from typing import Final

import can
from can.typechecking import CanFilter

EXTENDED_FLAG: Final = 0x8000_0000
IDENTIFIER_MASK: Final = 0x1FFF_FFFF
_STANDARD_MASK: Final = 0x7FF
MAX_SERVER_FILTERS: Final = 512
_FILTERS_PER_PART: Final = 8
_FIRST_PART: Final = 1
_LAST_PART: Final = 2
_FILTER: Final = struct.Struct("<2I")
_PASS_ALL: Final = (0, 0)


class FrameFilter:
    """The filters of a connection, each once.

    Attributes:
        is_for_server: Tells if the server can filter. It takes at most 512 filters; with more it passes all frames, and
            `passes` decides.
    """

    def __init__(self, filters: Collection[CanFilter] | None) -> None:
        """Compiles filters; None or no filter passes all frames.

        Raises:
            ValueError: A `can_id` has more than 29 bits.
        """
        compiled = [pair for pair in map(_compile, filters) if pair is not None] if filters else [_PASS_ALL]
        pairs = dict.fromkeys(compiled)
        self.is_for_server = len(pairs) <= MAX_SERVER_FILTERS
        self._encoded = [_FILTER.pack(*pair) for pair in (pairs if self.is_for_server else [_PASS_ALL])]
        self._identifiers: dict[int, set[int]] = {}
        for identifier, mask in pairs:
            self._identifiers.setdefault(mask, set()).add(identifier)

    def passes(self, message: can.Message) -> bool:
        """Returns whether a filter passes a frame. Error frames are not filtered."""
        if message.is_error_frame:
            return True
        identifier = message.arbitration_id | (EXTENDED_FLAG if message.is_extended_id else 0)
        return any(identifier & mask in identifiers for mask, identifiers in self._identifiers.items())

    def encode(self) -> bytes:
        """Returns the filters as they stand in a hello."""
        return b"".join(self._encoded)

    def encode_parts(self) -> list[bytes]:
        """Returns the datagrams that replace the filters of a connection."""
        count = max(1, -(-len(self._encoded) // _FILTERS_PER_PART))
        parts = []
        for number in range(count):
            flags = (_FIRST_PART if number == 0 else 0) | (_LAST_PART if number == count - 1 else 0)
            first = number * _FILTERS_PER_PART
            parts.append(b"F" + bytes([flags]) + b"".join(self._encoded[first : first + _FILTERS_PER_PART]))
        return parts


def _compile(one: CanFilter) -> tuple[int, int] | None:
    """Returns identifier and mask of a filter, with the flag of the frames that `extended` selects.

    Returns None for a filter that passes no frame: one for 11 bits with a higher bit set. The server, like the kernel,
    would ignore that bit.
    """
    identifier, mask = one["can_id"], one["can_mask"] & IDENTIFIER_MASK
    if not 0 <= identifier <= IDENTIFIER_MASK:
        raise ValueError(
            f"the filter's can_id {identifier:#x} has more than 29 bits: flags of SocketCAN, such as the inverting "
            'one, are not supported; use the key "extended" for frames of 11 or 29 bits'
        )
    if "extended" in one:
        mask |= EXTENDED_FLAG
        identifier |= EXTENDED_FLAG if one["extended"] else 0
        if not one["extended"] and identifier & mask & IDENTIFIER_MASK > _STANDARD_MASK:
            return None
    return identifier & mask, mask
