"""Captures as third-party libraries read and write them; each frame or note is one line of words.

    captures.py can-read LOG                  python-can: candump text
    captures.py can-copy LOG OUT              python-can reads and writes candump text
    captures.py mcap-read MCAP                mcap and mcap-ros2-support
    captures.py bag-read MCAP                 rosbags
    captures.py mcap-copy MCAP OUT PACKING    mcap-ros2-support writes what it has read, packed by none, lz4 or zstd
    captures.py mcap-loose MCAP OUT           mcap writes it without chunks
"""

import sys
from pathlib import Path


def of_can(message):
    flags = f"{int(message.is_fd)}{int(message.bitrate_switch)}{int(message.error_state_indicator)}"
    kind = f"{int(message.is_extended_id)}{int(message.is_remote_frame)}{flags}"
    data = bytes(message.data).hex() or "-"
    return f"{round(message.timestamp * 1e6)} {message.channel} {message.arbitration_id:X} {kind} {message.dlc} {data}"


def can_read(log):
    import can

    for message in can.CanutilsLogReader(log):
        print(of_can(message))


def can_copy(log, out):
    import can

    with can.CanutilsLogWriter(out) as writer:
        for message in can.CanutilsLogReader(log):
            writer.on_message_received(message)


def of_ros(topic, time, message):
    """Every field of a frame or a note."""
    stamp = f"{message.header.stamp.sec}.{message.header.stamp.nanosec:09}"
    head = f"{topic} {time} {stamp} {message.header.frame_id or '-'}"
    if topic == "/can/notes":
        words = (message.kind, message.frames, message.line)
        return f"{head} {' '.join(map(str, words))} {message.text.encode().hex() or '-'} {bytes(message.bytes).hex() or '-'}"
    flags = (message.is_extended, message.is_rtr, message.is_error, message.is_fd)
    numbers = (message.flags, message.length, message.raw_dlc, message.direction)
    words = [f"{message.id:X}", "".join(str(int(flag)) for flag in flags), *map(str, numbers)]
    return f"{head} {' '.join(words)} {bytes(message.data).hex() or '-'}"


def mcap_read(path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, ros in reader.iter_decoded_messages(log_time_order=False):
            print(of_ros(channel.topic, message.log_time, ros))


def bag_read(path):
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([Path(path)], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, time, raw in reader.messages():
            print(of_ros(connection.topic, time, reader.deserialize(raw, connection.msgtype)))


def mcap_copy(path, out, packing):
    from mcap.reader import make_reader
    from mcap.writer import CompressionType
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.writer import Writer

    options = {
        "none": {"compression": CompressionType.NONE, "enable_crcs": False},
        "lz4": {"compression": CompressionType.LZ4},
        "zstd": {"compression": CompressionType.ZSTD, "chunk_size": 4096},
    }[packing]
    schemas = {}
    with open(path, "rb") as file, open(out, "wb") as copy:
        writer = Writer(copy, **options)
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, ros in reader.iter_decoded_messages(log_time_order=False):
            if schema.name not in schemas:
                schemas[schema.name] = writer.register_msgdef(schema.name, schema.data.decode())
            times = {"log_time": message.log_time, "publish_time": message.publish_time}
            writer.write_message(channel.topic, schemas[schema.name], ros, sequence=message.sequence, **times)
        writer.finish()


def mcap_loose(path, out):
    from mcap.reader import make_reader
    from mcap.writer import Writer

    channels = {}
    with open(path, "rb") as file, open(out, "wb") as copy:
        writer = Writer(copy, use_chunking=False)
        writer.start()
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if channel.id not in channels:
                of = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of, channel.metadata)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


COMMANDS = {
    "can-read": can_read,
    "can-copy": can_copy,
    "mcap-read": mcap_read,
    "bag-read": bag_read,
    "mcap-copy": mcap_copy,
    "mcap-loose": mcap_loose,
}

if __name__ == "__main__":
    COMMANDS[sys.argv[1]](*sys.argv[2:])
