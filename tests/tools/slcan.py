"""python-can's slcan on a terminal: sends the frames of a file, and prints those that it receives.

    slcan.py TERMINAL fd|classic FRAMES COUNT

A frame is a line of: identifier in hexadecimal, kind (of x extended, r remote, f FD, b bit rate switch; - for none),
number of bytes, and the bytes in hexadecimal or -. It prints "ready", then COUNT frames as they come. Each line of its
standard input is a number of frames that it may send.
"""

import itertools
import sys
import threading

import can


def read(line: str) -> can.Message:
    """The frame of a line."""
    identifier, kind, length, data = line.split()
    return can.Message(
        arbitration_id=int(identifier, 16),
        is_extended_id="x" in kind,
        is_remote_frame="r" in kind,
        is_fd="f" in kind,
        bitrate_switch="b" in kind,
        dlc=int(length),
        data=b"" if data == "-" else bytes.fromhex(data),
    )


def written(message: can.Message) -> str:
    """The line of a frame."""
    flags = {
        "x": message.is_extended_id,
        "r": message.is_remote_frame,
        "f": message.is_fd,
        "b": message.bitrate_switch,
    }
    kind = "".join(letter for letter, is_set in flags.items() if is_set) or "-"
    data = "" if message.is_remote_frame else bytes(message.data).hex()
    return f"{message.arbitration_id:X} {kind} {message.dlc} {data or '-'}"


def main() -> None:
    """Opens, sends and receives."""
    terminal, form, path, count = sys.argv[1:]
    rates = {"bitrate": 500_000}
    if form == "fd":
        rates = {
            "timing": can.BitTimingFd.from_sample_point(
                f_clock=80_000_000,
                nom_bitrate=1_000_000,
                nom_sample_point=80,
                data_bitrate=5_000_000,
                data_sample_point=75,
            )
        }
    with open(path, encoding="ascii") as file:
        frames = [read(line) for line in file]
    with can.Bus(interface="slcan", channel=terminal, sleep_after_open=0, **rates) as bus:
        print("ready", flush=True)
        waiting = iter(frames)
        credits = (int(line) for line in sys.stdin)
        sender = threading.Thread(
            target=lambda: [bus.send(frame) for credit in credits for frame in itertools.islice(waiting, credit)]
        )
        sender.start()
        for _ in range(int(count)):
            message = bus.recv(30)
            if message is None:
                sys.exit("no frame arrived for 30 s")
            print(written(message), flush=True)
        sender.join()


main()
