#!/usr/bin/env python3
"""Closes skinbus' control loop from another program: a push on its skin moves the arm.

    python3 external_controller.py SOCKET [--damping NM_S_PER_RAD]

SOCKET is the path in the skin's [controller] table. The law is an admittance without inertia,
velocity = torque / damping. The datagrams are described in docs/how-to/external-controller.md.
"""

import argparse
import socket
import struct
import sys
import time

HEAD = struct.Struct("<4sHH")
STATE = struct.Struct("<4sHHQQIIII")  # then positions, velocities and torques, n of each
ANSWER = struct.Struct("<4sHHQII")  # then n numbers
MAX_BYTES = STATE.size + 3 * 32 * 8
MAGIC, VERSION = b"SKBC", 1
KIND_STATE, KIND_ANSWER, KIND_HELLO = 1, 2, 3
VALID, HALTED = 1, 2
VELOCITY = 1


def values(joints):
    """How many numbers of each kind a datagram has: one a joint, but at least six."""
    return max(6, joints)


def newest(own):
    """Waits for a state, and returns the last one if several are there; None when none comes."""
    state = None
    own.settimeout(0.5)
    try:
        while True:
            data = own.recv(MAX_BYTES + 1)
            if len(data) >= STATE.size and HEAD.unpack_from(data) == (MAGIC, VERSION, KIND_STATE):
                if len(data) == STATE.size + 3 * 8 * values(STATE.unpack_from(data)[-1]):
                    state = data
            own.setblocking(False)
    except (BlockingIOError, TimeoutError):
        return state


def control(own, gateway, damping):
    """Answers states until the gateway is gone."""
    own.sendto(HEAD.pack(MAGIC, VERSION, KIND_HELLO), gateway)
    states, next_report = 0, time.monotonic() + 1.0
    while True:
        data = newest(own)
        if data is None:  # a new gateway may listen there, which does not know us yet
            own.sendto(HEAD.pack(MAGIC, VERSION, KIND_HELLO), gateway)
            continue
        _, _, _, tick, time_us, age, cells, flags, joints = STATE.unpack_from(data)
        n = values(joints)
        numbers = struct.unpack_from(f"<{3 * n}d", data, STATE.size)
        q, torque = numbers[:n], numbers[2 * n :]
        usable = flags & VALID and not flags & HALTED
        velocity = [tau / damping if usable else 0.0 for tau in torque]
        answer = ANSWER.pack(MAGIC, VERSION, KIND_ANSWER, tick, VELOCITY, 0)
        own.sendto(answer + struct.pack(f"<{n}d", *velocity), gateway)
        states += 1
        if time.monotonic() >= next_report:
            next_report += 1.0
            halted = "  HALTED" if flags & HALTED else ""
            print(
                f"{time_us / 1e6:8.2f} s  {states:4d} states  {cells:3d} cells  age {age}"
                f"  q {' '.join(f'{x:+.2f}' for x in q[:joints])}"
                f"  torque {' '.join(f'{x:+.2f}' for x in torque[:joints])}{halted}",
                flush=True,
            )
            states = 0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("socket", help="the path in the skin's [controller] table")
    parser.add_argument("--damping", type=float, default=4.0, help="Nm s/rad (default: 4)")
    arguments = parser.parse_args()
    own = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    own.bind("")  # the system chooses a name, so that the gateway can answer
    waiting = False
    while True:
        try:
            control(own, arguments.socket, arguments.damping)
        except (FileNotFoundError, ConnectionRefusedError):
            if not waiting:
                print(f"waiting for a gateway at {arguments.socket}", file=sys.stderr, flush=True)
            waiting = True
            time.sleep(0.2)
        except (BlockingIOError, TimeoutError):
            time.sleep(0.01)  # the gateway's queue is full, or it is still starting; the next state will come


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(130)
