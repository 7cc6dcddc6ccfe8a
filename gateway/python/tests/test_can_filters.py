"""Tests of filters of the interface of python-can against a server."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from can.typechecking import CanFilter
from can_tools import TIMEOUT_S, Served, fields, random_frames, receive, serve


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """Serves a bus."""
    with serve(tmp_path / "buses") as bus:
        yield bus


def model_passes(filters: list[CanFilter], frame: can.Message) -> bool:
    """Returns whether a frame passes filters, as python-can documents it."""
    if not filters:
        return True
    return any(
        frame.arbitration_id & one["can_mask"] == one["can_id"] & one["can_mask"]
        and one.get("extended", frame.is_extended_id) == frame.is_extended_id
        for one in filters
    )


def random_filters(source: random.Random, count: int) -> list[CanFilter]:
    """Returns filters that many of `random_frames` pass."""
    filters: list[CanFilter] = []
    for _ in range(count):
        mask = source.choice((0, 1, 3, 0x700, 0x7FF, 0x1FFF_FFFF, 0xFFFF_FFFF, source.getrandbits(32)))
        one: CanFilter = {"can_id": source.getrandbits(source.choice((3, 11, 29))), "can_mask": mask}
        if source.random() < 0.5:
            one["extended"] = source.random() < 0.5
        filters.append(one)
    return filters


@pytest.mark.parametrize("count", [0, 1, 2, 9, 512, 1500])
def test_filters_pass_what_python_can_documents(served: Served, count: int) -> None:
    """Filters of the hello and changed filters are those of a pure model, also more than the server takes."""
    source = random.Random(count)
    end = can.Message(is_error_frame=True, arbitration_id=1)
    with served.open() as sender:
        for round_number in range(6):
            first, second = random_filters(source, count), random_filters(source, count)
            if count > 512:
                # Without masks that pass everything.
                first, second = ([one for one in some if one["can_mask"] > 3] for some in (first, second))
            with served.open(can_filters=first) as receiver:
                for filters in (first, second, first):
                    receiver.set_filters(filters)
                    # The server reads the change before a frame that the same connection sends afterwards.
                    receiver.send(end)
                    frames = random_frames(100, seed=source.getrandbits(30))
                    assert sender.recv(TIMEOUT_S) is not None
                    for frame in [*frames, end]:
                        sender.send(frame)
                    expected = [fields(frame) for frame in frames if model_passes(filters, frame)] + [fields(end)]
                    got = [fields(frame) for frame in receive(receiver, len(expected))]
                    assert got == expected, (round_number, filters)


def test_filter_that_no_frame_can_pass(served: Served) -> None:
    """A filter for 11 bits with a higher bit passes nothing, unlike that of the kernel, which ignores the bit."""
    never: CanFilter = {"can_id": 0x1123, "can_mask": 0x1FFF_FFFF, "extended": False}
    with served.open() as sender, served.open(can_filters=[never]) as first, served.open() as second:
        second.set_filters([never])
        second.send(can.Message(arbitration_id=1))
        receive(sender, 1)
        sender.send(can.Message(arbitration_id=0x123, is_extended_id=False))
        sender.send(can.Message(is_error_frame=True, arbitration_id=4))
        assert [frame.is_error_frame for bus in (first, second) for frame in receive(bus, 1)] == [True, True]


def test_filters_with_flags_are_refused(served: Served) -> None:
    """Flags of SocketCAN would silently pass other frames; the filters before stay."""
    with served.open(can_filters=[{"can_id": 1, "can_mask": 0x7FF}]) as bus:
        with pytest.raises(ValueError, match="more than 29 bits"):
            bus.set_filters([{"can_id": 0x2000_0123, "can_mask": 0x7FF}])
        assert bus.filters == [{"can_id": 1, "can_mask": 0x7FF}]
        bus.filters = None
        assert bus.filters is None
