"""A run's recording as other people's libraries read it: each message is one line of its fields' values.

    recording.py mcap MCAP        mcap and mcap-ros2-support
    recording.py bag MCAP         rosbags

Structures are walked by their fields' names in order. Numbers with a fraction are their 8 bytes in hexadecimal,
little endian; what is no number is `null`.
"""

import dataclasses
import math
import struct
import sys
from pathlib import Path


def leaves(value):
    if isinstance(value, str):
        yield value.encode().hex() or "-"
    elif isinstance(value, (bytes, bytearray)):
        yield from map(str, value)
    elif hasattr(value, "tolist"):
        yield from leaves(value.tolist())
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from leaves(one)
    elif isinstance(value, (bool, int)):
        yield str(int(value))
    elif isinstance(value, float):
        yield struct.pack("<d", value).hex() if math.isfinite(value) else "null"
    else:
        known = dataclasses.is_dataclass(value)
        names = [field.name for field in dataclasses.fields(value)] if known else type(value).__slots__
        # rosbags has the type's name and its constants as fields, too.
        for name in sorted(name for name in names if name.islower() and not name.startswith("_")):
            yield from leaves(getattr(value, name))


def show(topic, time, message):
    print(topic, time, *leaves(message))


def by_mcap(path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages(log_time_order=False):
            show(channel.topic, message.log_time, ros)


def by_rosbags(path):
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(path)]) as reader:
        for connection, time, raw in reader.messages():
            show(connection.topic, time, reader.deserialize(raw, connection.msgtype))


if __name__ == "__main__":
    {"mcap": by_mcap, "bag": by_rosbags}[sys.argv[1]](sys.argv[2])
