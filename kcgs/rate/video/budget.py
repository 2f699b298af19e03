"""The bytes of a clip, shared out among its frames."""

from __future__ import annotations

import math

from kcgs.codec.clips.file import KEY, ClipHeader, Record, pack_end, pack_header, pack_record

# how many carried frames cost what a key frame does, and how many times its even share a carried one may take
_KEY_FRAMES, _MOST = 4.5, 1.6
# by how much a step of the quantization parameter changes the logarithm of a carried frame's bytes; share of a
# difference that the next frame makes up for; the largest step
SLOPE, _MADE_UP, _LARGEST = 0.0073, 0.8, 48
# bytes that each frame to come is sure of; most that a record takes beside its content
_LEAST, _RECORD = 48, 16


class Budget:
    """What is left of `num_bytes` for `count` frames, key frames at least every `interval` of them."""

    def __init__(self, num_bytes: int, count: int, header: ClipHeader, interval: int) -> None:
        self._left = num_bytes - len(pack_header(header)) - len(pack_end(count))
        least = num_bytes - self._left + math.ceil((_KEY_FRAMES + count - 1) * _LEAST)
        if num_bytes < least:
            raise ValueError(f"target_bytes, or kbps, must allow {least} bytes for {count} frames; got {num_bytes}")
        self._frames, self._number, self._interval = count, 0, interval
        self._until = 0  # frames before the next key frame, if none comes earlier

    def spend(self, record: Record) -> None:
        """Take a frame off."""
        self._left -= len(pack_record(record, self._number))
        self._until = (self._interval if record.kind == KEY else self._until) - 1
        self._number += 1

    def for_key(self) -> int:
        """Return the bytes of a key frame that begins here, less those of its record."""
        return max(1, int(_KEY_FRAMES * self._fair(0) if self._rest > 1 else self._left) - _RECORD)

    def for_frame(self) -> int:
        """Return the bytes of any frame if all are like it, less those of its record."""
        return max(1, int(self._left / self._rest) - _RECORD)

    def most(self) -> int:
        """Return the bytes that a carried frame may have at most, less those of its record."""
        after = self._rest - 1
        fair = _MOST * self._fair(self._until) if after else self._left
        return max(0, int(min(self._left - after * _LEAST, fair)) - _RECORD)

    def step(self, num_bytes: int) -> int:
        """Return by how much the next frame's quantization parameter should rise, after a carried one of so many."""
        if self._rest < 1:
            return 0
        wanted = math.log(max(self._fair(self._until), 1.0) / max(num_bytes, 1)) / SLOPE
        return round(min(max(_MADE_UP * wanted, -_LARGEST), _LARGEST))

    @property
    def _rest(self) -> int:
        return self._frames - self._number

    def _fair(self, until: int) -> float:
        """Return the bytes of each carried frame if they are even, and key frames begin after so many frames."""
        keys = math.ceil(max(0, self._rest - until) / self._interval)
        return self._left / (keys * _KEY_FRAMES + self._rest - keys)
