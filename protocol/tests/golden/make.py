#!/usr/bin/env python3
"""Writes the golden frames of this folder. Needs nothing but Python's standard library.

This is a second implementation of docs/reference/cell.md and protocol.md, made from the document and not from the Rust
code, and it shares nothing with it: when the two disagree, one of them, or the document, is wrong.
Never "fix" a line of a log by copying what the Rust code prints.

    python3 make.py           write the logs
    python3 make.py --check   say whether the logs are what this script writes (exit code 1 if not)

Every frame is preceded by a comment line with its meaning: a word, then key=value fields. Numbers are
in the units of the document (quarter turns, Nm, N, g, degrees Celsius, m), as exact decimals.
`protocol/src/tests/golden.rs` builds a message from the comment alone and compares both directions.

    fd.log          every kind, page and parameter: bytes <-> meaning, both ways
    lenient.log     frames that are read although nobody should write them so: bytes -> meaning
    bad.log         frames that are refused, and why
    classic.log     pairs of classic frames, with the times between them
    session.log     a cell is configured, receives joints, is pressed and answers
    exchange.log    what one cell receives and sends, with times, from its start on: the cell of cell-node is run against it
    refusals.log    writes that a commit refuses, and the refusal
    wire.log        what cells say over the wires between them: bytes <-> meaning, and what is refused
    document.log    the frames spelled out in docs/reference
    arithmetic.json forces, torques and sums in words
"""

import json
import math
import pathlib
import random
import struct
import sys
from fractions import Fraction

HERE = pathlib.Path(__file__).parent

# --- CRC, words, packets -------------------------------------------------------------------------


def crc16(data):
    """CRC-16/CCITT-FALSE, bit by bit: polynomial 0x1021, start 0xFFFF, most significant bit first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


assert crc16(b"123456789") == 0x29B1

# Fraction bits.
ANGLE = LENGTH = UNIT = 14  # Q1.14
TORQUE = GAIN = ACCELERATION = 12  # Q3.12
FORCE = 10  # Q5.10
SUM = 8  # Q7.8
TEMPERATURE = 6  # Q9.6


def nearest(value, bits):
    """The word of the nearest step, ties away from zero; must be in range."""
    steps = Fraction(value) * 2**bits
    word = math.floor(abs(steps) + Fraction(1, 2)) * (1 if steps >= 0 else -1)
    assert -(2**15) <= word < 2**15, f"{value} does not fit"
    return word


def at_least(value, bits):
    """The word of the smallest step that is not below the value: how thresholds are rounded."""
    word = math.ceil(Fraction(value) * 2**bits)
    assert -(2**15) <= word < 2**15, f"{value} does not fit"
    return word


def angle(radians):
    """Quarter turns, wrapped into [-2, 2)."""
    steps = radians / (2 * math.pi) * 65536
    word = math.floor(abs(steps) + 0.5) * (1 if steps >= 0 else -1)
    return signed(word & 0xFFFF)


def signed(word):
    assert 0 <= word < 2**16
    return word - 2**16 if word & 0x8000 else word


def number(word, bits):
    """The word's value as an exact decimal (every dyadic fraction of 16 bits is one)."""
    text = repr(word / 2**bits)
    return text[:-2] if text.endswith(".0") else text


def numbers(words, bits):
    return ",".join(number(word, bits) for word in words)


def words_for(joints):
    """How many words joints, torques and sums of a chain have."""
    return next(words for words in (6, 8, 10, 14) if words >= joints)


class Packet:
    """Sixteen bytes under an identifier; 20, 24 or 32 of a longer chain's joints, torques and sums."""

    def __init__(self, meaning, kind, node, words=(), epoch=0, count=0):
        self.meaning, self.id = meaning, kind << 8 | node
        self.words = list(words)
        self.words += [0] * (words_for(len(self.words)) - len(self.words))
        self.epoch, self.count = epoch, count

    def body(self):
        return struct.pack(f"<{len(self.words)}hBB", *self.words, self.epoch, self.count)

    def crc(self):
        return crc16(struct.pack("<H", self.id) + self.body())

    def bytes(self):
        return self.body() + struct.pack("<H", self.crc())

    def fd(self, flags=5):
        return f"{self.id:03X}##{flags:X}{self.bytes().hex().upper()}"

    def segments(self):
        data = self.bytes()
        return [f"{self.id:03X}#{data[at : at + 8].hex().upper()}" for at in range(0, len(data), 8)]


# --- Messages ------------------------------------------------------------------------------------

EVERYONE, GATEWAY = 255, 0
NAME = {EVERYONE: "everyone", GATEWAY: "gateway"}


def node(n):
    return NAME.get(n, str(n))


def command(name):
    return Packet(name, 0, {"halt": 0, "sync": 2, "resume": 3, "report": 4}[name])


def joints(epoch, words, in_use=6):
    assert all(word == 0 for word in words[in_use:])
    meaning = f"joints epoch={epoch} in_use={in_use} positions={numbers(words, ANGLE)}"
    return Packet(meaning, 0, 1, words, epoch, in_use)


def total(sender, epoch, words, count):
    meaning = f"sum from={sender} epoch={epoch} count={count} torque={numbers(words, SUM)}"
    return Packet(meaning, 1, sender, words, epoch, count)


def torque(sender, epoch, words):
    meaning = f"torque from={sender} epoch={epoch} torque={numbers(words, TORQUE)}"
    return Packet(meaning, 2, sender, words, epoch, 1)


def skin(contact, proximity=0, temperature=(0, 0)):
    text = (
        f"contact={numbers(contact, FORCE)} proximity={number(proximity, UNIT)}"
        f" temperature={numbers(temperature, TEMPERATURE)}"
    )
    return text, 0, [*contact, proximity, *temperature]


def acceleration(xyz):
    return f"acceleration={numbers(xyz, ACCELERATION)}", 1, list(xyz)


def sensors(sender, epoch, page):
    text, number_of_page, words = page
    return Packet(f"sensors from={sender} epoch={epoch} {text}", 3, sender, words, epoch, number_of_page)


def stimulus(to, epoch, page):
    """`epoch` is the first epoch, or None: from the next joints on."""
    text, number_of_page, words = page
    when = "from=next" if epoch is None else f"from={epoch}"
    flag = 0x80 if epoch is None else 0
    return Packet(f"stimulus to={node(to)} {when} {text}", 7, to, words, epoch or 0, number_of_page | flag)


STATE = {
    "configured": 0,
    "active": 1,
    "halted": 2,
    "flash-damaged": 3,
    "duplicate": 4,
    "test-mode": 5,
    "saturated": 6,
    "claiming": 7,
}


def heartbeat(sender, epoch, serial, configuration, sent, rejected, state=(), joint=0, version=1):
    bits = sum(1 << STATE[name] for name in state) | joint << 8 | version << 12
    words = [serial & 0xFFFF, serial >> 16, configuration, sent, rejected, bits]
    meaning = (
        f"heartbeat from={node(sender)} epoch={epoch} serial={serial} configuration={configuration:04X}"
        f" sent={sent} rejected={rejected} state={'+'.join(state) or 'none'} joint={joint} version={version}"
    )
    return Packet(meaning, 4, sender, map(signed, words), epoch, 0)


HEARD = ("joints", "joints_late", "joints_repeated", "stimuli", "stimuli_late", "torques")
REFUSED = ("length", "crc", "foreign", "meaning", "incomplete", "stimuli")


def counters(sender, epoch, page, values):
    name, keys = {1: ("heard", HEARD), 2: ("refused", REFUSED)}[page]
    fields = " ".join(f"{key}={value}" for key, value in zip(keys, values, strict=True))
    meaning = f"{name} from={node(sender)} epoch={epoch} {fields}"
    return Packet(meaning, 4, sender, [signed(value) for value in values], epoch, page)


NOBODY = 255


def tree(sender, epoch, parent, up, depth, round_, children, works, counters_of_sums):
    """`parent` is a node id, 0 for the gateway's side, or None."""
    byte = NOBODY if parent is None else parent
    sent, taken, dropped = counters_of_sums
    words = [byte | up << 8, depth | round_ << 8, children | works << 8, sent, taken, dropped]
    bits = lambda ports: "+".join(str(p) for p in range(8) if ports >> p & 1) or "none"
    meaning = (
        f"tree from={node(sender)} epoch={epoch} parent={'none' if parent is None else parent} up={up}"
        f" depth={depth} round={round_} children={bits(children)} works={bits(works)}"
        f" sent={sent} taken={taken} dropped={dropped}"
    )
    return Packet(meaning, 4, sender, [signed(word) for word in words], epoch, 3)


PORT = {"hears": 12, "works": 13, "other-version": 14}


def ports(sender, epoch, four, changes):
    """`four` has a number, a port and flags for each port."""
    words, texts = [], []
    for number_there, port_there, *flags in four:
        words.append(signed(number_there | port_there << 8 | sum(1 << PORT[flag] for flag in flags)))
        texts.append("/".join([str(number_there), str(port_there), "+".join(flags) or "none"]))
    fields = " ".join(f"port{index}={text}" for index, text in enumerate(texts))
    meaning = f"ports from={node(sender)} epoch={epoch} {fields} changes={changes}"
    return Packet(meaning, 4, sender, [*words, signed(changes)], epoch, 4)


# Parameters: (number, fields as text, words).


def identity():
    return 0, "", []


def mount(joint, of, row=0, rows=0, torque_format=0):
    text = f"joint={joint} joints={of}"
    if row or rows or torque_format:
        text += f" row={row} rows={rows} torque_format={torque_format}"
    return 1, text, [joint, of, row, rows, torque_format]


def pose(position, normal):
    words = [nearest(x, LENGTH) for x in position] + [nearest(x, UNIT) for x in normal]
    return 2, f"position={numbers(words[:3], LENGTH)} normal={numbers(words[3:], UNIT)}", words


def contact(alpha_c, alpha_p, contact_threshold, proximity_threshold, force_threshold):
    words = [
        nearest(alpha_c, GAIN),
        nearest(alpha_p, FORCE),
        at_least(contact_threshold, FORCE),
        at_least(proximity_threshold, UNIT),
        at_least(force_threshold, FORCE),
    ]
    text = (
        f"alpha_c={number(words[0], GAIN)} alpha_p={number(words[1], FORCE)}"
        f" contact_threshold={number(words[2], FORCE)} proximity_threshold={number(words[3], UNIT)}"
        f" force_threshold={number(words[4], FORCE)}"
    )
    return 3, text, words


def timing(period_us):
    return 4, f"period_us={period_us}", [signed(period_us)]


def mode(on):
    return 5, f"on={on}", [on]


def reply_torque():
    return 6, "reply=torque", [0]


def reply_sum(slot_us, deepest, carry):
    text = f"reply=sum slot_us={slot_us} deepest={deepest} carry={carry}"
    return 6, text, [1, signed(slot_us), deepest, carry]


def sensing(kind, period_ms=0):
    period = f" period_ms={period_ms}" if kind == "continuous" else ""
    return 7, f"sensing={kind}{period}", [("off", "continuous", "event").index(kind), signed(period_ms)]


def events(contact_n, proximity, temperature, acceleration_g, hysteresis):
    words = [
        nearest(contact_n, FORCE),
        nearest(proximity, UNIT),
        nearest(temperature, TEMPERATURE),
        nearest(acceleration_g, ACCELERATION),
        nearest(hysteresis, UNIT),
    ]
    text = (
        f"contact={number(words[0], FORCE)} proximity={number(words[1], UNIT)}"
        f" temperature={number(words[2], TEMPERATURE)} acceleration={number(words[3], ACCELERATION)}"
        f" hysteresis={number(words[4], UNIT)}"
    )
    return 8, text, words


def links_down(*deaf):
    return 9, f"deaf={'+'.join(map(str, deaf)) or 'none'}", [sum(1 << port for port in deaf)]


BASELINES = ("off", "hold", "follow")


def baseline(kind, threshold=0, hysteresis=0, rate_un_per_s=0, limit=0, n_per_c=0):
    """Threshold and limit in N, the slope in N/degree."""
    words = [at_least(threshold, FORCE), nearest(hysteresis, UNIT), signed(rate_un_per_s)]
    words += [nearest(limit, FORCE), nearest(n_per_c, UNIT)]
    text = f"baseline={kind}"
    if kind != "off":
        text += (
            f" threshold={number(words[0], FORCE)} hysteresis={number(words[1], UNIT)} rate_un_per_s={rate_un_per_s}"
            f" limit={number(words[3], FORCE)} n_per_c={number(words[4], UNIT)}"
        )
    return 11, text, [BASELINES.index(kind), *words]


def tare(word):
    return 12, f"tare={word}", [word]


def zero(force, n_per_c, found_at, state, refused):
    """Sensors page 3: the zero in steps of a contact word, the slope and the temperature in theirs."""
    text = (
        f"zero={number(force, FORCE)} n_per_c={number(n_per_c, UNIT)} found_at={number(found_at, TEMPERATURE)}"
        f" flags={'+'.join(state) or 'none'} refused={refused}"
    )
    bits = sum(1 << ("tared", "touched", "limited").index(name) for name in state)
    return text, 3, [force, n_per_c, found_at, bits, signed(refused)]


def row(number_of_row, a, d, alpha, theta_offset, kind="revolute"):
    words = [nearest(a, LENGTH), nearest(d, LENGTH), angle(alpha), angle(theta_offset), KINDS.index(kind)]
    text = (
        f"a={number(words[0], LENGTH)} d={number(words[1], LENGTH)}"
        f" alpha={number(words[2], ANGLE)} theta_offset={number(words[3], ANGLE)}"
    )
    if kind != "revolute":
        text += f" kind={kind}"
    return 15 + number_of_row, text, words


KINDS = ("revolute", "prismatic", "fixed")
# What a cell of this version can: joints, rows, prismatic and fixed rows, torques in Q5.10 and Q7.8.
ABILITIES = 14 | 32 << 4 | 1 << 10 | 1 << 11 | 1 << 12 | 1 << 13


def commit(value):
    return 127, f"hash={value:04X}", [signed(value)]


def raw(number_of_parameter, words):
    return number_of_parameter, f"words={','.join(map(str, words))}", words


def read(to, tag, parameter):
    return Packet(f"read to={node(to)} tag={tag} parameter={parameter}", 5, to, [], tag, parameter)


def write(to, tag, parameter):
    number_of_parameter, text, words = parameter
    meaning = f"write to={node(to)} tag={tag} parameter={number_of_parameter} {text}"
    return Packet(meaning, 5, to, words, tag, number_of_parameter | 0x80)


def value(sender, tag, parameter, written):
    number_of_parameter, text, words = parameter
    name = "written" if written else "value"
    meaning = f"{name} from={sender} tag={tag} parameter={number_of_parameter} {text}".rstrip()
    return Packet(meaning, 6, sender, words, tag, number_of_parameter | (0x80 if written else 0))


def refusal(sender, tag, parameter, reason):
    meaning = f"refusal from={sender} tag={tag} parameter={parameter} reason={reason}"
    return Packet(meaning, 6, sender, [parameter, reason], tag, 126)


def configuration_hash(parameters):
    """Over the words of parameters 1, 2, 3, 4, 16..21, six each."""
    image = b""
    for number in (1, 2, 3, 4, 16, 17, 18, 19, 20, 21):
        words = next((words for found, _, words in parameters if found == number), [])
        image += struct.pack("<6h", *words, *[0] * (6 - len(words)))
    assert len(image) == 120
    return crc16(image)


# --- Wires ---------------------------------------------------------------------------------------


class Wire:
    """Eight bytes under an identifier of 29 bits: kind, five bytes, CRC over identifier and kind to byte 5."""

    def __init__(self, meaning, link, kind, *rest):
        self.meaning, self.link = meaning, link
        self.body = bytes([kind, *rest, *[0] * (5 - len(rest))])

    def id(self):
        wire, back = self.link
        return 0x10000000 | wire << 1 | back

    def crc(self):
        return crc16(struct.pack("<I", self.id()) + self.body)

    def bytes(self):
        return self.body + struct.pack("<H", self.crc())

    def classic(self):
        return f"{self.id():08X}#{self.bytes().hex().upper()}"


def over(link, text):
    name, *fields = text.split(" ", 1)
    return " ".join([name, f"wire={link[0]}", f"back={link[1]}", *fields])


HELLO = {"hears": 3, "up": 4, "unnumbered": 5}


def hello(link, number_here, port, flags=(), label=None, version=1):
    """`label` is (round, depth), or None."""
    bits = port | sum(1 << HELLO[flag] for flag in flags) | (label is not None) << 6
    text = "none" if label is None else f"{label[0]}/{label[1]}"
    meaning = (
        f"hello version={version} node_id={number_here} port={port} flags={'+'.join(flags) or 'none'} label={text}"
    )
    return Wire(over(link, meaning), link, 1, version, number_here, bits, *(label or (0, 0)))


def bare_wire(link, name):
    return Wire(over(link, name), link, {"join": 2, "refuse": 4, "leave": 5, "leave_ack": 6, "probe": 12}[name])


def grant(link, round_, depth):
    return Wire(over(link, f"grant label={round_}/{depth}"), link, 3, round_, depth)


def state_of(link, epoch):
    return Wire(over(link, f"state epoch={epoch}"), link, 7, epoch)


def nack(link, epoch):
    return Wire(over(link, f"nack epoch={epoch}"), link, 8, epoch)


def repair(link, round_):
    return Wire(over(link, f"repair round={round_}"), link, 9, round_)


def walk(link, name, which, first, last):
    kind = {"node_id": 10, "result": 11}[name]
    return Wire(over(link, f"{name} walk={which} first={first} last={last}"), link, kind, which, first, last)


# --- What a cell computes ------------------------------------------------------------------------


def fused_force(parameters, contact_words, proximity):
    """Algorithm 1 in integers: F_z in steps of 2^-24 N, and whether the cell is active."""
    alpha_c, alpha_p, contact_th, proximity_th, force_th = parameters
    f_c = sum(contact_words)
    if f_c < contact_th:
        f_c = 0
    f_p = proximity
    if f_p < proximity_th:
        f_p = 0
    f_z = (alpha_c * f_c << 2) + alpha_p * f_p
    return f_z, f_z >= force_th << 14


def torque_words(jacobian, f_z):
    """J (Q1.14) times F_z (rounded to 16 fraction bits), rounded half up to Q3.12, saturated."""
    f_z = (f_z + (1 << 7)) >> 8
    words = []
    for j in jacobian:
        word = (j * f_z + (1 << 17)) >> 18
        words.append(max(-(2**15), min(2**15 - 1, word)))
    return words


def cross(u, v):
    return [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]


def exact_jacobian(chain, theta, position, normal):
    """J_l = z_(l-1) . ((t - p_(l-1)) x f), f = -normal, in floating point, in the base frame."""
    axes, origins = [], []
    r = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]
    p = [0.0, 0.0, 0.0]
    for (a, d, alpha, offset), q in zip(chain, theta, strict=True):
        axes.append([r[i][2] for i in range(3)])
        origins.append(list(p))
        c, s = math.cos(q + offset), math.sin(q + offset)
        ca, sa = math.cos(alpha), math.sin(alpha)
        # Rz(theta) Tz(d) Tx(a) Rx(alpha)
        t = [a * c, a * s, d]
        m = [[c, -s * ca, s * sa], [s, c * ca, -c * sa], [0, sa, ca]]
        p = [p[i] + sum(r[i][j] * t[j] for j in range(3)) for i in range(3)]
        r = [[sum(r[i][k] * m[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
    where = [p[i] + sum(r[i][j] * position[j] for j in range(3)) for i in range(3)]
    force = [-sum(r[i][j] * normal[j] for j in range(3)) for i in range(3)]
    result = []
    for z, o in zip(axes, origins, strict=True):
        moment = cross([where[i] - o[i] for i in range(3)], force)
        result.append(sum(z[i] * moment[i] for i in range(3)))
    return result + [0.0] * (6 - len(result))


# --- The logs ------------------------------------------------------------------------------------

MAX, MIN = 2**15 - 1, -(2**15)


class Log:
    """Lines of a candump log with their comments; time runs on by itself."""

    def __init__(self, name, *head):
        self.name, self.micros = name, 1_700_000_000_000_000
        self.lines = [f"# {line}" for line in ("Written by make.py; see there.", *head)] + [""]

    def title(self, text):
        self.lines += ["", f"## {text}"] if self.lines[-1] else [f"## {text}"]

    def add(self, meaning, frame, after_us=1_000):
        self.micros += after_us
        seconds, rest = divmod(self.micros, 1_000_000)
        self.lines += [f"# {meaning}".rstrip(), f"({seconds}.{rest:06}) vcan0 {frame}"]

    def put(self, *packets):
        for packet in packets:
            self.add(packet.meaning, packet.fd())

    def say(self, *wires):
        for wire in wires:
            self.add(wire.meaning, wire.classic())

    def text(self):
        return "\n".join(self.lines) + "\n"


PRESSED = skin([1024, 1024, 1024])


def fd():
    log = Log("fd.log", "Bytes and meaning, both ways.")
    rng = random.Random(20260101)
    words = lambda: [rng.randint(MIN, MAX) for _ in range(6)]
    cell = lambda: rng.randint(1, 254)
    epoch = lambda: rng.randint(0, 255)
    u16 = lambda: rng.randint(0, 65535)

    log.title("commands")
    log.put(*(command(name) for name in ("halt", "sync", "resume", "report")))
    log.put(
        joints(0, [0] * 6),
        joints(255, [MIN, MAX, -1, 1, 16384, -16384]),
        joints(128, [angle(x) for x in (0.0, -1.2, 1.0, -1.4, -1.57, math.pi)]),
        joints(1, [8192, 0, 0, 0, 0, 0], in_use=1),
        joints(2, [8192, -8192, 100, 0, 0, 0], in_use=3),
    )
    log.put(*(joints(epoch(), words()) for _ in range(3)))
    long_words = lambda count: [rng.randint(MIN, MAX) for _ in range(count)]
    log.title("joints of longer chains: 8, 10 and 14 words")
    for count in range(7, 15):
        padding = [0] * (words_for(count) - count)
        log.put(joints(count, long_words(count) + padding, in_use=count))
    log.title("sums and torques of longer chains")
    for count in (8, 10, 14):
        log.put(total(12, 9, [MAX, MIN] + long_words(count - 2), 2), total(12, 10, [0] * count, 0))
        log.put(torque(12, 9, [MIN, MAX] + long_words(count - 2)), torque(12, 10, [0] * count))

    log.title("sums")
    log.put(
        total(1, 0, [256, -256, 1, -1, 0, 128], 1),
        total(254, 255, [MAX, MIN, MAX - 1, MIN + 1, 0, 0], 255),
        total(12, 9, [0] * 6, 0),
        *(total(cell(), epoch(), words(), rng.randint(1, 255)) for _ in range(3)),
    )

    log.title("torques")
    log.put(
        torque(1, 0, [0] * 6),
        torque(12, 7, [4096, -2048, 1, -1, 0, 0]),
        torque(254, 255, [MAX, MIN, MAX - 1, MIN + 1, 0, -1]),
        *(torque(cell(), epoch(), words()) for _ in range(3)),
    )

    log.title("sensors")
    log.put(
        sensors(1, 0, skin([0, 0, 0])),
        sensors(12, 9, skin([1024, 1023, -1], 16384, [25 * 64, -40 * 64])),
        sensors(254, 255, skin([MAX, MIN, 1], MAX, [MIN, MAX])),
        sensors(7, 3, acceleration([0, 0, 4096])),
        sensors(7, 4, acceleration([MAX, MIN, -1])),
        *(sensors(cell(), epoch(), skin(words()[:3], words()[0], words()[:2])) for _ in range(2)),
    )

    log.title("network: heartbeats, one for every bit of the state, then the counters, the tree, the ports")
    log.put(
        heartbeat(12, 7, 100001, 0xBEEF, 4711, 3, ("configured", "active"), 2),
        heartbeat(1, 0, 0, 0, 0, 0),
        heartbeat(254, 255, 2**32 - 1, 0xFFFF, 65535, 65535, tuple(STATE), 15, 15),
        heartbeat(GATEWAY, 200, 1, 0, 1, 0),
        *(heartbeat(5, 6, 0x00010002, 0x8000, 0x0100, 0x8001, (name,), 1) for name in STATE),
        counters(12, 7, 1, [1000, 2, 3, 40, 5, 600]),
        counters(254, 255, 1, [65535, 65534, 32768, 32767, 1, 0]),
        counters(12, 7, 2, [1, 20, 300, 4000, 50000, 6]),
        counters(254, 255, 2, [65535, 65534, 32768, 32767, 1, 0]),
        *(counters(cell(), epoch(), page, [u16() for _ in range(6)]) for page in (1, 2)),
    )
    log.put(
        tree(12, 7, 3, 1, 4, 2, 0b0101, 0b0111, (1000, 200, 3)),
        tree(1, 0, 0, 4, 0, 255, 0b1111, 0b11111, (65535, 32768, 1)),
        tree(254, 255, 254, 3, 253, 128, 0b1000, 0b1000, (0, 65535, 32767)),
        tree(9, 200, None, 0, 0, 7, 0, 0b0010, (5, 6, 7)),
        ports(12, 7, [(3, 2, "hears", "works"), (0, 0), (254, 3, "hears"), (7, 0, "hears", "other-version")], 2),
        ports(254, 255, [(254, 3, *PORT)] * 4, 65535),
        ports(1, 0, [(0, 4, "hears", "works"), (0, 0), (0, 0), (0, 0)], 0),
    )

    log.title("configure: reading")
    log.put(*(read(12, parameter, parameter) for parameter in (0, *range(1, 10), *range(16, 48), 127)))
    log.put(read(EVERYONE, 255, 0), read(254, 0, 99))

    log.title("configure: writing")
    log.put(
        write(12, 1, mount(2, 6)),
        write(12, 2, pose((Fraction("0.1"), 0, Fraction("0.06")), (0, 0, 1))),
        write(12, 3, pose((-2, Fraction(32767, 16384), -1), (Fraction("0.6"), Fraction("-0.8"), 0))),
        write(12, 4, contact(1, 0, Fraction("0.1"), Fraction("0.05"), Fraction("0.1"))),
        write(12, 5, contact(Fraction(32767, 4096), Fraction(32767, 1024), 0, 1, Fraction(1, 1024))),
        write(12, 6, timing(16000)),
        write(12, 7, timing(65535)),
        write(12, 8, mode(1)),
        write(12, 9, mode(0)),
        *(write(EVERYONE, 9 + joint, row(joint, *UR5[joint - 1])) for joint in range(1, 7)),
        write(12, 16, row(1, -2, Fraction(32767, 16384), -math.pi, 3 * math.pi)),
        write(12, 17, commit(0xBEEF)),
        write(EVERYONE, 255, commit(0)),
        write(12, 18, mount(8, 8, 11, 12, 1)),
        write(12, 19, mount(14, 14, 32, 32, 2)),
        write(12, 20, row(7, Fraction("0.088"), 0, math.pi / 2, 0.0)),
        write(12, 21, row(2, 0, Fraction("0.3"), 0.0, math.pi / 2, "prismatic")),
        write(12, 22, row(32, -1, Fraction("0.5"), 0.25, -0.5, "fixed")),
        write(254, 0, raw(99, [1, -1, MAX, MIN, 0, 256])),
    )

    log.title("configure: what is switched at run time")
    log.put(
        write(EVERYONE, 20, reply_sum(1500, 6, 1)),
        write(12, 21, reply_sum(65535, 253, 0)),
        write(EVERYONE, 22, reply_torque()),
        write(12, 23, sensing("continuous", 16)),
        write(12, 24, sensing("continuous", 65535)),
        write(EVERYONE, 25, sensing("event")),
        write(12, 26, sensing("off")),
        write(12, 27, events(Fraction("0.1"), Fraction("0.05"), Fraction("0.5"), Fraction("0.1"), Fraction("0.5"))),
        write(12, 28, events(Fraction(MAX, 1024), Fraction(MAX, 2**14), Fraction(MAX, 64), Fraction(MAX, 4096), 1)),
        write(12, 29, links_down(0, 2)),
        write(12, 30, links_down(0, 1, 2, 3, 4)),
        write(12, 31, links_down()),
    )

    log.title("configured: values, and every reason of a refusal")
    log.put(
        value(12, 0, raw(0, [signed(100001 & 0xFFFF), 100001 >> 16, 1, signed(0xBEEF), 0x1203, 0]), False),
        value(12, 1, mount(2, 6), True),
        value(12, 2, pose((0, 0, 0), (0, 0, 1)), False),
        value(12, 3, mode(1), True),
        value(254, 255, commit(0xBEEF), True),
        value(12, 4, reply_sum(1500, 6, 1), True),
        value(12, 5, sensing("off"), False),
        value(12, 6, events(Fraction("0.1"), Fraction("0.05"), Fraction("0.5"), Fraction("0.1"), Fraction("0.5")), False),
        value(12, 7, links_down(3), True),
        *(refusal(12, 200, 1, reason) for reason in (*range(1, 11), 16, 17, 18, 19)),
        refusal(254, 255, 127, 16),
    )

    log.title("stimuli")
    log.put(
        stimulus(12, 7, PRESSED),
        stimulus(12, 0, PRESSED),
        stimulus(12, 255, skin([0, 0, 0])),
        stimulus(12, None, PRESSED),
        stimulus(EVERYONE, None, skin([MAX, MIN, -1], -1, [MIN, MAX])),
        stimulus(254, 128, acceleration([4096, -4096, 1])),
        stimulus(EVERYONE, None, acceleration([0, 0, MIN])),
    )

    log.title("the baseline of a force sensor")
    log.put(*(read(12, parameter, parameter) for parameter in (11, 12)))
    log.put(
        write(12, 32, baseline("off")),
        write(EVERYONE, 33, baseline("hold", Fraction("0.1"), Fraction("0.5"), 0, Fraction("0.5"), Fraction("0.02"))),
        write(12, 34, baseline("follow", Fraction("0.1"), Fraction("0.5"), 2000, 1, Fraction("-0.02"))),
        write(12, 35, baseline("follow", Fraction(MAX, 1024), 1, 65535, Fraction(MAX, 1024), -2)),
        *(write(12, 36 + word, tare(word)) for word in (0, 1, 2)),
        value(12, 34, baseline("follow", Fraction("0.1"), Fraction("0.5"), 2000, 1, Fraction("-0.02")), True),
        value(12, 37, tare(1), True),
        *(refusal(12, 200, 12, reason) for reason in (20, 21)),
        sensors(12, 7, zero(307, -328, 1600, ("tared", "touched"), 1)),
        sensors(254, 255, zero(MIN, MAX, MIN, ("tared", "touched", "limited"), 65535)),
        sensors(1, 0, zero(0, 0, 0, (), 0)),
    )
    return log


def lenient():
    log = Log(
        "lenient.log",
        "What a receiver does not look at may be anything; a sender writes 0 there. Bytes to meaning only.",
    )

    def put(packet, flags=5, **changes):
        for key, changed in changes.items():
            assert getattr(packet, key) != changed
            setattr(packet, key, changed)
        log.add(packet.meaning, packet.fd(flags))

    log.title("commands other than joints: words, epoch and count")
    put(command("halt"), words=[1, 2, 3, 4, 5, 6], epoch=9, count=200)
    put(command("sync"), epoch=7)
    put(command("resume"), count=1)
    put(command("report"), words=[-1] * 6)
    log.title("words that a page does not use")
    put(sensors(3, 1, acceleration([1, 2, 3])), words=[1, 2, 3, 4, 5, 6])
    put(stimulus(3, 1, acceleration([1, 2, 3])), words=[1, 2, 3, -4, -5, -6])
    log.title("the epoch of a stimulus that holds from the next joints on")
    put(stimulus(3, None, PRESSED), epoch=77)
    put(ports(3, 1, [(5, 2, "hears"), (0, 0), (0, 0), (0, 0)], 1), words=[5 | 2 << 8 | 1 << 12, 0, 0, 0, 1, 77])
    log.title("the words of a read")
    put(read(3, 5, 2), words=[1, 2, 3, 4, 5, 6])
    log.title("a refusal with the bit of a write, and with words after the reason")
    put(refusal(3, 5, 2, 4), count=126 | 0x80)
    put(refusal(3, 5, 2, 4), words=[2, 4, 9, 9, 9, 9])
    log.title("FD flags: without FDF as kernels before 6.1 have it, without bit-rate switch, error passive")
    put(torque(12, 7, [1, 2, 3, 4, 5, 6]), flags=1)
    put(torque(12, 7, [1, 2, 3, 4, 5, 6]), flags=0)
    put(torque(12, 7, [1, 2, 3, 4, 5, 6]), flags=4)
    put(torque(12, 7, [1, 2, 3, 4, 5, 6]), flags=7)
    return log


def bad():
    log = Log("bad.log", "Frames on an FD bus that are refused, and why.")
    good = torque(12, 7, [4096, -2048, 1, -1, 0, 0])

    log.title("CRC: one bit, other bytes, another cell's name, the CRC's bytes swapped, nothing but zeros")
    data = good.bytes()

    def wrong_crc(identifier, bytes16):
        expected = crc16(struct.pack("<H", identifier) + bytes16[:14])
        got = struct.unpack("<H", bytes16[14:])[0]
        assert expected != got
        frame = f"{identifier:03X}##5{bytes16.hex().upper()}"
        log.add(f"bad crc expected={expected:04X} got={got:04X}", frame)

    for bit in (0, 7, 8, 95, 96, 111, 112, 127):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        wrong_crc(good.id, bytes(flipped))
    wrong_crc(0x20D, data)
    wrong_crc(0x10C, data)
    wrong_crc(good.id, data[:14] + data[15:] + data[14:15])
    wrong_crc(0x000, bytes(16))
    wrong_crc(good.id, b"\xff" * 16)
    without_identifier = data[:14] + struct.pack("<H", crc16(data[:14]))
    wrong_crc(good.id, without_identifier)

    log.title("length")
    for length in (0, 8, 12, 48, 64):
        body = (data * 4)[:length].hex().upper()
        log.add(f"bad length expected=16 got={length}", f"20C##5{body}")
    # What is not about joints does not grow.
    for length in (20, 24, 32):
        body = (data * 4)[:length].hex().upper()
        log.add(f"bad length expected=16 got={length}", f"30C##5{body}")
    first, second = good.segments()
    log.add("bad length expected=16 got=8", first)
    log.add("bad length expected=16 got=8", second)

    log.title("29-bit identifiers")
    log.add("bad foreign", f"0000020C##5{data.hex().upper()}")
    log.add("bad foreign", f"1FFFFFFF##5{data.hex().upper()}")

    def meaningless(error, kind, number_of_node, count, words=()):
        packet = Packet("", kind, number_of_node, words, 7, count)
        log.add(f"bad {error}", packet.fd())

    log.title("commands that do not exist")
    for number_of_command in (5, 6, 0x7F, 0xFF):
        meaningless(f"command node={number_of_command}", 0, number_of_command, 0)
    log.title("counts that cannot be")
    for count in (0, 7, 255):
        meaningless(f"count kind=command got={count} allowed=1-to-6", 0, 1, count)
    for words, count, allowed in ((8, 6, "7-or-8"), (8, 9, "7-or-8"), (10, 8, "9-or-10"), (14, 10, "11-to-14"), (14, 15, "11-to-14")):
        meaningless(f"count kind=command got={count} allowed={allowed}", 0, 1, count, [0] * words)
    meaningless("count kind=sum got=0 allowed=1-to-255-or-0-with-zeros", 1, 12, 0, (0, 256))
    for count in (0, 2, 255):
        meaningless(f"count kind=torque got={count} allowed=1", 2, 12, count)
    log.title("senders and addressees that cannot be")
    for kind, name, count in ((1, "sum", 1), (2, "torque", 1), (3, "sensors", 0), (6, "configured", 0)):
        for number_of_node in (0, 255):
            meaningless(f"sender kind={name} node={number_of_node}", kind, number_of_node, count)
    meaningless("sender kind=network node=255", 4, 255, 0)
    meaningless("addressee kind=configure node=0", 5, 0, 0)
    meaningless("addressee kind=stimulus node=0", 7, 0, 0)
    log.title("pages that do not exist")
    for page in (2, 127, 128, 129, 255):
        meaningless(f"page kind=sensors page={page}", 3, 12, page)
    for page in (5, 128, 255):
        meaningless(f"page kind=network page={page}", 4, 12, page)
    for count, page in ((2, 2), (0x82, 2), (0xFF, 0x7F)):
        meaningless(f"page kind=stimulus page={page}", 7, 12, count)
    return log


def classic():
    log = Log(
        "classic.log",
        "Frames on a classic bus, one after the other, and what becomes of each. The times matter.",
    )
    first, second = "waiting", "whole"

    def half(packet, index, outcome, after_us):
        meaning = f"whole {packet.meaning}" if outcome == "whole" else outcome
        log.add(meaning, packet.segments()[index], after_us)

    a = [torque(12, epoch, [epoch * 100, -epoch, 3, 4, 5, 6]) for epoch in range(20)]
    b = [torque(13, epoch, [-epoch * 100, epoch, 3, 4, 5, 6]) for epoch in range(20)]

    log.title("pairs of every kind")
    for packet in (
        command("halt"),
        joints(255, [MIN, MAX, -1, 1, 16384, -16384]),
        total(1, 0, [MAX, MIN, 1, -1, 0, 0], 255),
        torque(254, 255, [MAX, MIN, 1, -1, 0, 0]),
        sensors(12, 9, skin([1024, 1023, -1], 16384, [1600, -2560])),
        heartbeat(12, 7, 100001, 0xBEEF, 4711, 3, ("configured", "active"), 2),
        read(12, 3, 0),
        write(12, 1, mount(2, 6)),
        refusal(12, 200, 1, 3),
        stimulus(EVERYONE, None, PRESSED),
    ):
        half(packet, 0, first, 500)
        half(packet, 1, second, 150)

    log.title("two cells speak at once: segments are reassembled by identifier")
    half(a[1], 0, first, 1000)
    half(b[1], 0, first, 120)
    half(a[1], 1, second, 120)
    half(b[1], 1, second, 120)

    for (near, far, after), ms in ((a[2:5], 15), ([stimulus(12, None, PRESSED)] * 3, 100)):
        log.title(f"exactly {ms} ms apart is a pair; 1 us more is not: the packet is counted, once")
        half(near, 0, first, 1000)
        half(near, 1, second, ms * 1000)
        half(far, 0, first, 1000)
        half(far, 1, "incomplete", ms * 1000 + 1)
        half(after, 0, first, ms * 1000 + 1)
        half(after, 1, second, 150)

    log.title("a lost second half costs its own packet only")
    half(a[5], 0, first, 1000)
    half(a[6], 0, "incomplete", 2000)
    half(a[6], 1, second, 150)

    log.title("a lost first half costs its own packet only")
    half(a[7], 1, first, 1000)
    half(a[8], 0, "incomplete", 2000)
    half(a[8], 1, second, 150)

    log.title("a half that came twice")
    half(a[9], 0, first, 1000)
    half(a[9], 0, "incomplete", 100)
    half(a[9], 1, second, 100)

    log.title("a frame of another length is refused and leaves the waiting half alone")
    half(a[10], 0, first, 1000)
    for length in (0, 7):
        log.add(f"bad length expected=8 got={length}", f"20C#{'AA' * length}", 100)
    half(a[10], 1, second, 100)

    log.title("remote frames, error frames and 29-bit identifiers are foreign")
    for frame in ("20C#R8", "20C#R", "20000004#0001000000000000", f"0000020C#{'00' * 8}"):
        log.add("bad foreign", frame)

    log.title("a wrong CRC drops the older half; the newer one waits, falls to the next first half and is not counted")
    half(a[11], 0, first, 1000)
    spoilt = a[11].segments()[1]
    log.add("incomplete", spoilt[:-1] + ("0" if spoilt[-1] != "0" else "1"), 150)
    half(a[12], 0, first, 1000)
    half(a[12], 1, second, 150)

    log.title("longer packets: segments of 8 bytes, the last as long as what is left")
    for packet in (
        joints(1, [100, -200, 300, -400, 500, -600, 700, 0], in_use=7),
        torque(12, 1, [MAX, MIN, 1, -1, 0, 0, 7, 8]),
    ):
        half(packet, 0, first, 500)
        half(packet, 1, first, 150)
        half(packet, 2, second, 150)

    log.title("a whole pair without a meaning")
    odd = Packet("", 0, 9, [], 0, 0)
    log.add("waiting", odd.segments()[0])
    log.add("whole bad command node=9", odd.segments()[1], 150)
    return log


UR5 = [
    (Fraction(0), Fraction("0.089159"), math.pi / 2, 0.0),
    (Fraction("-0.425"), Fraction(0), 0.0, 0.0),
    (Fraction("-0.39225"), Fraction(0), 0.0, 0.0),
    (Fraction(0), Fraction("0.10915"), math.pi / 2, 0.0),
    (Fraction(0), Fraction("0.09465"), -math.pi / 2, 0.0),
    (Fraction(0), Fraction("0.0823"), 0.0, 0.0),
]

# The cell of the document: on the UR5's second link.
CELL, JOINT, SERIAL = 12, 2, 100001
PARAMETERS = [
    mount(JOINT, 6),
    pose((Fraction("0.1"), Fraction("0.05"), Fraction("0.06")), (0, Fraction("0.8"), Fraction("0.6"))),
    contact(1, 0, Fraction("0.1"), Fraction("0.05"), Fraction("0.1")),
    timing(16000),
    *(row(joint, *UR5[joint - 1]) for joint in range(1, 7)),
]
ANGLES = (0.0, -1.2, 1.0, -1.4, -1.57, 0.0)


def answer(contact_words):
    """The cell's torque for ANGLES: its Jacobian from the words it has, in exact arithmetic."""
    by_number = {number_of_parameter: words for number_of_parameter, _, words in PARAMETERS}
    real = lambda words: [word / 2**14 for word in words]
    quarter = math.pi / 2
    chain = []
    for joint in range(1, JOINT + 1):
        a, d, alpha, offset, _ = real(by_number[15 + joint])
        chain.append((a, d, alpha * quarter, offset * quarter))
    theta = [angle(q) / 2**14 * quarter for q in ANGLES[:JOINT]]
    placed = real(by_number[2])
    jacobian = [nearest(j, 14) for j in exact_jacobian(chain, theta, placed[:3], placed[3:])]
    f_z, active = fused_force(by_number[3], contact_words, 0)
    return jacobian, f_z, active, torque_words(jacobian, f_z)


def session():
    log = Log(
        "session.log",
        "A cell is configured, hears joints, is pressed and answers.",
        "Its Jacobian is computed in floating point from the words and rounded to nearest: another",
        "cell's may differ by a step or two of 2^-14, and its torque accordingly.",
    )
    value_of = configuration_hash(PARAMETERS)
    log.title("the cell claims its node id, and is there 250 ms later")
    log.put(heartbeat(CELL, 0, SERIAL, 0, 0, 0, ("claiming",)), heartbeat(CELL, 0, SERIAL, 0, 1, 0))
    log.title("the gateway writes every parameter")
    for tag, parameter in enumerate(PARAMETERS, 1):
        log.put(write(CELL, tag, parameter), value(CELL, tag, parameter, True))
    log.title("a commit with a wrong hash, and one with the right hash")
    log.put(write(CELL, 11, commit(value_of ^ 1)), refusal(CELL, 11, 127, 16))
    log.put(write(CELL, 12, commit(value_of)), value(CELL, 12, commit(value_of), True))
    log.title("test mode")
    log.put(write(CELL, 13, mode(1)), value(CELL, 13, mode(1), True))
    log.title("pressed with 3 N from epoch 7 on, and released from the next joints on")
    words = [angle(q) for q in ANGLES]
    log.put(
        stimulus(CELL, 7, PRESSED),
        joints(6, words),
        joints(7, words),
        torque(CELL, 7, answer([1024] * 3)[3]),
        stimulus(CELL, None, skin([0, 0, 0])),
        joints(8, words),
        torque(CELL, 8, [0] * 6),
        joints(9, words),
        command("sync"),
        heartbeat(CELL, 9, SERIAL, value_of, 17, 0, ("configured", "test-mode"), JOINT),
        command("report"),
        counters(CELL, 9, 1, [4, 0, 0, 2, 0, 2]),
        counters(CELL, 9, 2, [0] * 6),
        sensors(CELL, 9, skin([0, 0, 0])),
        sensors(CELL, 9, acceleration([0, 0, 0])),
    )
    return log


# --- What one cell receives and sends ------------------------------------------------------------

# The first heartbeat, (serial mod 64) ms after the start, and the one that ends claiming, in us.
FIRST = SERIAL % 64 * 1_000
SETTLED = FIRST + 250_000 + 250_000 * CELL // 255
HASH = configuration_hash(PARAMETERS)


class Exchange:
    """One cell from its start on: `bus` is what it receives, `cell` what it sends, at times in us after the start."""

    def __init__(self, log, title, flash="empty", test=0, form="fd"):
        self.log, self.form, self.sent = log, form, 0
        self.start = (log.micros // 10_000_000 + 1) * 10_000_000
        log.title(title)
        log.micros = self.start
        log.lines.append(f"# start node={CELL} serial={SERIAL} flash={flash} test={test} format={form}")
        self.configured = flash == "session"
        self.test = test

    def put(self, who, at, packet):
        frames = [packet.fd()] if self.form == "fd" else packet.segments()
        for index, frame in enumerate(frames):
            part = "" if self.form == "fd" else f"{index + 1}/2 "
            self.frame(f"{who} {part}{packet.meaning}", at + 200 * index * (who == "bus"), frame)

    def frame(self, meaning, at, frame):
        self.log.add(meaning, frame, self.start + at - self.log.micros)

    def bus(self, at, *packets):
        for index, packet in enumerate(packets):
            self.put("bus", at + 1_000 * index, packet)

    def cell(self, at, *packets):
        for packet in packets:
            self.put("cell", at, packet)
            self.sent += 1

    def beat(self, at, *state, epoch=0, rejected=0):
        """A heartbeat of the cell; what is always so of its state need not be said."""
        known = [*(["configured"] if self.configured else []), *(["test-mode"] if self.test else [])]
        state = [name for name in STATE if name in (*state, *known)]
        value_of, joint = (HASH, JOINT) if self.configured else (0, 0)
        self.cell(at, heartbeat(CELL, epoch, SERIAL, value_of, self.sent, rejected, tuple(state), joint))

    def settle(self, epoch=0):
        self.beat(FIRST, "claiming")
        self.beat(SETTLED, epoch=epoch)


def claim_of(serial, claims=True):
    return heartbeat(CELL, 0, serial, 0, 0, 0, ("claiming",) if claims else ())


def exchange():
    log = Log(
        "exchange.log",
        "What one cell receives (bus) and sends (cell), from its start on. What it sends at once has here the time of what",
        "it answers; docs/reference/cell.md says how much later it may be. Nothing else is sent between the lines.",
    )
    words = [angle(q) for q in ANGLES]
    pressed = answer([1024] * 3)[3]

    x = Exchange(log, "CLAIM-1 CLAIM-2 CLAIM-5 BEAT-1 BEAT-3 BEAT-4 CMD-1 CMD-2 CMD-3 CMD-4 JOINTS-2 STIM-1 SENSE-1 TIME-3: a start without a configuration")
    x.beat(FIRST, "claiming")
    x.bus(FIRST + 1_000, command("sync"), command("report"), read(CELL, 1, 0), write(CELL, 2, mode(1)))
    x.beat(SETTLED)
    x.beat(SETTLED + 250_000)
    x.bus(600_000, command("sync"))
    x.beat(600_000)
    x.beat(SETTLED + 500_000)
    x.bus(800_000, command("halt"), joints(7, words), command("sync"))
    x.beat(802_000, "halted", epoch=7)
    x.bus(803_000, command("resume"), stimulus(CELL, None, PRESSED), joints(8, words), command("sync"))
    x.beat(806_000, epoch=8, rejected=1)
    x.bus(807_000, read(CELL, 3, 0))
    state = 1 << 12
    identity_of = [signed(SERIAL & 0xFFFF), SERIAL >> 16, 1, 0, state, ABILITIES]
    x.cell(807_000, value(CELL, 3, raw(0, identity_of), False))
    x.bus(808_000, command("report"))
    x.cell(808_000, counters(CELL, 8, 1, [2, 0, 0, 0, 0, 0]), counters(CELL, 8, 2, [0, 0, 0, 0, 0, 1]))
    x.cell(808_000, sensors(CELL, 8, skin([0, 0, 0])), sensors(CELL, 8, acceleration([0, 0, 0])))

    x = Exchange(log, "CLAIM-3 CLAIM-7 STATE-2: two claim a node id, and the lower serial number stays: before and after its first heartbeat")
    x.bus(10_000, claim_of(200_000))
    x.beat(10_000, "claiming", "duplicate")
    x.bus(15_000, claim_of(200_000))
    x.beat(FIRST, "claiming", "duplicate")
    x.bus(50_000, claim_of(200_000))
    x.beat(50_000, "claiming", "duplicate")
    x.beat(SETTLED)

    x = Exchange(log, "CLAIM-3 CLAIM-4: two claim a node id, and the higher serial number gives way")
    x.beat(FIRST, "claiming")
    x.bus(FIRST + 5_000, claim_of(99_999))
    x = Exchange(log, "CLAIM-3 CLAIM-4: a claimant gives way to a cell that is settled, before its own first heartbeat")
    x.bus(5_000, claim_of(500_000, claims=False))
    x = Exchange(log, "CLAIM-3 CLAIM-4: a claimant gives way to anything but a heartbeat under its node id")
    x.beat(FIRST, "claiming")
    x.bus(FIRST + 5_000, counters(CELL, 0, 1, [0] * 6))

    x = Exchange(log, "CLAIM-6 CLAIM-7: a settled cell answers a claimant, at most every 10 ms, and nobody else")
    x.settle()
    x.bus(300_000, claim_of(7))
    x.beat(300_000, "duplicate")
    x.bus(305_000, claim_of(7))
    x.bus(310_000, claim_of(7))
    x.beat(310_000, "duplicate")
    x.bus(320_000, claim_of(500_000, claims=False))
    x.beat(SETTLED + 250_000, "duplicate")
    x.beat(SETTLED + 500_000)

    x = Exchange(log, "OPT-1 CONF-1 CONF-2 CONF-3 CONF-4 CONF-5 CONF-6 CONF-7 CONF-9 CONF-12 CONF-13 COUNT-2 SENSE-3 SENSE-4: configuration without ports")
    x.settle()
    x.bus(295_000, read(CELL, 0, 1))
    x.cell(295_000, value(CELL, 0, raw(1, [0] * 6), False))
    at, tag = 300_000, 0

    def ask(request, reply):
        nonlocal at, tag
        at, tag = at + 1_000, tag + 1
        x.bus(at, request)
        x.cell(at, reply)

    def writes(parameter, now=None):
        """`now`: the words that it has then, where they are not those that were written."""
        changed = parameter if now is None else raw(parameter[0], now)
        ask(write(CELL, tag, parameter), value(CELL, tag, changed, True))

    def reads(parameter):
        ask(read(CELL, tag, parameter[0]), value(CELL, tag, parameter, False))

    def refuses(parameter, reason, of=None):
        ask(write(CELL, tag, parameter), refusal(CELL, tag, parameter[0] if of is None else of, reason))

    for number_of_parameter, _, given in PARAMETERS:
        unused = [-7] * (6 - len(given))
        writes(raw(number_of_parameter, [*given, *unused]), [*given, *[0] * len(unused)])
    refuses(raw(1, [300, 300]), 2)
    refuses(raw(1, [300, 6]), 3)
    reads(mount(JOINT, 6))
    refuses(commit(HASH ^ 1), 16)
    writes(raw(127, [signed(HASH), 1, 2, 3, 4, 5]), [signed(HASH), 0, 0, 0, 0, 0])
    x.configured = True
    reads(PARAMETERS[2])
    reads(raw(127, [0] * 6))
    refuses(raw(0, [1] * 6), 1)
    refuses(raw(99, [1] * 6), 18)
    ask(read(CELL, tag, 126), refusal(CELL, tag, 126, 18))
    # The one with the lowest number of several reasons.
    writes(raw(1, [0, 15]))
    writes(raw(2, [0] * 6))
    writes(raw(4, [0]))
    refuses(commit(0), 2, of=127)
    writes(raw(1, [0, 6]))
    refuses(commit(0), 3, of=127)
    writes(mount(JOINT, 6))
    refuses(commit(0), 4, of=127)
    reads(PARAMETERS[3])
    refuses(links_down(), 19)
    writes(raw(5, [7, 1]), [0] * 6)
    writes(raw(5, [1, 2, 3, 4, 5, 6]), [1, 0, 0, 0, 0, 0])
    x.test = 1
    reads(reply_torque())
    writes(raw(6, [0, 1500, 6, 1]), [0] * 6)
    refuses(reply_sum(1500, 6, 1), 19)
    writes(raw(9, [0b100000]), [0] * 6)
    refuses(links_down(0), 19)
    thresholds = events(Fraction("0.1"), Fraction("0.05"), Fraction("0.5"), Fraction("0.1"), Fraction("0.5"))
    reads(thresholds)
    writes(raw(8, [1, 2, 3, 4, 5, -1]), [1, 2, 3, 4, 5, 0])
    refuses(raw(8, [1, 2, 3, 4, -1, 0]), 19)
    reads(raw(8, [1, 2, 3, 4, 5, 0]))
    writes(raw(7, [2, 77]), [2, 0, 0, 0, 0, 0])
    x.cell(at, sensors(CELL, 0, skin([0, 0, 0])), sensors(CELL, 0, acceleration([0, 0, 0])))
    refuses(sensing("continuous", 0), 19)
    writes(raw(7, [0, 16]), [0] * 6)
    x.bus(at + 1_000, command("sync"))
    x.beat(at + 1_000)

    x = Exchange(log, "JOINTS-1 JOINTS-3 JOINTS-5 JOINTS-6 TORQUE-1 TORQUE-2 STATE-1 STATE-2 STATE-3 STIM-3 STIM-4 STIM-5 STIM-7 STIM-8: contact", "session", test=1)
    x.beat(FIRST, "claiming")
    x.bus(290_000, stimulus(CELL, None, PRESSED), joints(1, words))
    x.beat(SETTLED, epoch=1)
    x.bus(300_000, joints(2, words))
    x.cell(300_000, torque(CELL, 2, pressed))
    x.bus(301_000, joints(2, words), joints(3, [*words[:5], 0], in_use=5))
    x.bus(316_000, joints(3, words))
    x.cell(316_000, torque(CELL, 3, pressed))
    x.bus(320_000, stimulus(CELL, None, skin([MAX] * 3)))
    x.bus(332_000, joints(4, words))
    x.cell(332_000, torque(CELL, 4, answer([MAX] * 3)[3]))
    x.bus(333_000, command("sync"))
    x.beat(333_000, "active", "saturated", epoch=4, rejected=1)
    x.bus(334_000, command("sync"))
    x.beat(334_000, "active", epoch=4, rejected=1)
    x.bus(335_000, command("halt"))
    x.bus(348_000, joints(5, words), command("sync"))
    x.beat(349_000, "halted", epoch=5, rejected=1)
    x.bus(350_000, command("resume"), stimulus(EVERYONE, None, PRESSED))
    x.bus(364_000, joints(6, words))
    x.cell(364_000, torque(CELL, 6, pressed))
    x.bus(365_000, stimulus(CELL, 7, skin([0, 0, 0])))
    x.bus(380_000, joints(7, words))
    x.cell(380_000, torque(CELL, 7, [0] * 6))
    x.bus(396_000, joints(8, words), stimulus(CELL, 10, PRESSED))
    x.bus(412_000, joints(9, words))
    x.bus(428_000, joints(10, words))
    x.cell(428_000, torque(CELL, 10, pressed))
    x.bus(429_000, stimulus(CELL, 10, skin([0, 0, 0])))
    x.bus(444_000, joints(200, words))
    x.cell(444_000, torque(CELL, 200, [0] * 6))
    x.bus(445_000, command("report"))
    x.cell(445_000, counters(CELL, 200, 1, [11, 0, 1, 6, 1, 7]), counters(CELL, 200, 2, [0, 0, 0, 1, 0, 0]))
    x.cell(445_000, sensors(CELL, 200, skin([0, 0, 0])), sensors(CELL, 200, acceleration([0, 0, 0])))

    x = Exchange(log, "COUNT-1 COUNT-3: segments on a classic bus: interleaved, lost, of another length", "session", 1, "classic")
    x.settle()

    def segment(at, packet, index):
        x.frame(f"bus {index}/2 {packet.meaning}", at, packet.segments()[index - 1])

    x.bus(300_000, stimulus(CELL, None, PRESSED), joints(1, words))
    x.cell(301_200, torque(CELL, 1, pressed))
    # Of joints 2 only the first segment comes: the next one that comes is a segment of joints 3.
    segment(317_000, joints(2, words), 1)
    x.bus(333_000, joints(3, words))
    x.cell(333_200, torque(CELL, 3, pressed))
    release = stimulus(CELL, None, skin([0, 0, 0]))
    for at, packet, index in ((349_000, release, 1), (349_100, joints(4, words), 1), (349_200, release, 2)):
        segment(at, packet, index)
    segment(349_300, joints(4, words), 2)
    x.cell(349_300, torque(CELL, 4, [0] * 6))
    segment(365_000, joints(5, words), 1)
    x.frame("bus of another length", 365_100, "001#00")
    x.frame("bus of another format", 365_200, joints(5, words).fd())
    segment(365_300, joints(5, words), 2)
    # The two segments come further apart than 15 ms: the second one waits, and goes with the next first one.
    segment(380_000, joints(6, words), 1)
    segment(395_001, joints(6, words), 2)
    x.bus(396_000, joints(7, words), command("sync"))
    x.beat(397_200, epoch=7, rejected=4)
    x.bus(398_000, command("report"))
    x.cell(398_200, counters(CELL, 7, 1, [5, 0, 0, 2, 0, 3]), counters(CELL, 7, 2, [2, 0, 0, 0, 2, 0]))
    x.cell(398_200, sensors(CELL, 7, skin([0, 0, 0])), sensors(CELL, 7, acceleration([0, 0, 0])))
    return log


# --- Arithmetic ----------------------------------------------------------------------------------


class Rows:
    """A JSON file with a row a line."""

    name = "arithmetic.json"

    def __init__(self, **sections):
        self.sections = sections

    def text(self):
        section = lambda rows: ",\n".join(f"    {json.dumps(row)}" for row in rows)
        sections = (f'  "{name}": [\n{section(rows)}\n  ]' for name, rows in self.sections.items())
        return "{\n" + ",\n".join(sections) + "\n}\n"


def forces():
    """Parameter 3, a sensors page and J: F_z with 16 fraction bits, and the words of the torque."""
    plain = [4096, 0, 0, 0, 0]
    fused = [4096, 512, 256, 2048, 256]
    cases = [
        (plain, [1024, 1024, 1024, 0]),
        (plain, [MAX, MAX, MAX, 0]),
        (plain, [MIN, MIN, MIN, 0]),
        (plain, [1, 0, 0, 0]),
        (plain, [-5, 3, 3, 0]),
        (fused, [256, 0, 0, 0]),
        (fused, [255, 0, 0, 0]),
        (fused, [100, 100, 56, 2048]),
        (fused, [0, 0, 0, 8192]),
        (fused, [0, 0, 0, 8191]),
        (fused, [0, 0, 0, 2047]),
        ([MAX, MAX, 0, 0, 0], [MAX, MAX, MAX, MAX]),
        ([1, 0, 0, 0, 0], [1, 0, 0, 0]),
        ([1, 1, 0, 0, 0], [0, 0, 0, 127]),
        ([1, 1, 0, 0, 0], [0, 0, 0, 128]),
    ]
    jacobians = [[-1433, 4260, 0, 0, 0, 0], [MAX, MIN, 1, -1, 8191, -8192], [3, -3, 7, -7, 13_926, 0]]
    rows = []
    for index, (rule, sensors) in enumerate(cases):
        f_z, active = fused_force(rule, sensors[:3], sensors[3])
        f_z = max(0, (f_z + (1 << 7)) >> 8) if active else 0
        jacobian = jacobians[index % len(jacobians)]
        words = [max(MIN, min(MAX, (j * f_z + (1 << 17)) >> 18)) for j in jacobian]
        rows.append({"contact": rule, "sensors": [*sensors, 0, 0], "force": f_z, "jacobian": jacobian, "torque": words})
    return rows


def sums():
    """Epochs of one cell: J and F_z of the cell itself, the children's sums, and what is sent. Carry begins at 0."""
    slow, j = [], [1433, -4260, 16_384, 1, -1, 0]
    own = lambda f_z: {"jacobian": j, "force": f_z}
    child = lambda *words, count=1: {"words": (list(words) + [0] * 6)[:6], "count": count}
    slow = [(own(9_000 + 700 * step), []) for step in range(8)]
    mixed = [
        (own(196_608), [child(256, -256, 1, -1)]),
        (own(196_608), [child(MAX - 300, MIN + 300, count=3), child(200, -200, 5, count=2)]),
        (own(196_608), [child(MAX, MIN, 0, 7, count=4), child(-400, 400, count=2)]),
        (None, [child(1, 2, 3, 4, 5, 6, count=9), child(-1, -2, -3, -4, -5, -6, count=1)]),
        (own(2**31 - 1), []),
        (own(1), []),
        (None, []),
        (None, []),
    ]
    rows = []
    for carries, course in ((1, slow), (0, slow), (1, mixed)):
        carry, before, epochs = [0] * 6, 0, []
        for own_of, children in course:
            total_of, count, saturated = [0] * 6, 0, [False] * 6
            if own_of is None:
                carry = [0] * 6
            else:
                count = 1
                for l in range(6):
                    x = own_of["jacobian"][l] * own_of["force"] + (carry[l] if carries else 0)
                    total_of[l] = (x + (1 << 21)) >> 22
                    carry[l] = x - (total_of[l] << 22)
            for sum_of in children:
                count += sum_of["count"]
                for l, word in enumerate(sum_of["words"]):
                    saturated[l] |= word in (MAX, MIN)
                    total_of[l] += word
            held = [
                (MIN if t < 0 else MAX) if s or not MIN <= t <= MAX else t for t, s in zip(total_of, saturated, strict=True)
            ]
            sends = {"words": held, "count": count} if count or before else None
            epochs.append({"own": own_of, "children": children, "sends": sends})
            before = count
        rows.append({"carry": carries, "epochs": epochs})
    return rows


def arithmetic():
    return Rows(forces=forces(), sums=sums())



def refusals():
    log = Log(
        "refusals.log",
        "Each write, on top of the sound configuration of session.log, and the refusal that it earns: of the",
        "write itself, or (parameter 127) of a commit after it, whatever its hash.",
    )
    by_number = {parameter[0] for parameter in PARAMETERS}
    steep = lambda n: pose((0, 0, 0), n)
    at_once = [(raw(1, [1, -1]), 2), (raw(1, [1, 256]), 2), (raw(1, [-1, 6]), 3), (raw(1, [256, 6]), 3)]
    at_once += [(raw(1, [2, 6, -1, 6]), 8), (raw(1, [2, 6, 2, 256]), 7), (raw(16, [0, 0, 0, 0, 3]), 9)]
    at_once += [(raw(1, [2, 6, 0, 0, 3]), 10), (raw(1, [2, 6, 0, 0, -1]), 10)]
    at_commit = [
        (mount(1, 0), 2),
        (mount(1, 15), 2),
        (mount(0, 6), 3),
        (mount(4, 3), 3),
        (steep((0, 0, 0)), 4),
        (steep((0, 0, Fraction("1.01"))), 4),
        (steep((0, 0, Fraction("0.99"))), 4),
        *((raw(3, [-1 if i == word else 1 for i in range(5)]), 5) for word in range(5)),
        (timing(0), 6),
        (mount(2, 6, 2, 33), 7),
        (mount(2, 6, 2, 5), 7),
        (mount(2, 6, 2, 7), 7),
        (row(3, 0, 0, 0.0, 0.0, "prismatic"), 7),
        (mount(2, 6, 3, 6), 8),
        (mount(2, 6, 0, 6), 8),
        (mount(2, 6, 2, 0), 8),
    ]
    tag = 0

    def case(parameter, refused, reason):
        nonlocal tag
        tag += 1
        log.put(write(CELL, tag, parameter), refusal(CELL, tag, refused, reason))

    log.title("numbers that are not written like this, or not at all")
    case(raw(0, [1] * 6), 0, 1)
    for unknown in (10, 15, 48, 126):
        case(raw(unknown, [1] * 6), unknown, 18)
    log.title("words that cannot even be staged")
    for parameter, reason in at_once:
        assert parameter[0] in by_number
        case(parameter, parameter[0], reason)
    log.title("words that a switch cannot have, and a link taken down outside test mode")
    for parameter in (
        raw(6, [2, 1500, 6, 1]),
        raw(6, [-1, 1500, 6, 1]),
        raw(6, [1, 0, 6, 1]),
        raw(6, [1, 1500, -1, 1]),
        raw(6, [1, 1500, 254, 1]),
        raw(6, [1, 1500, 6, 2]),
        raw(6, [1, 1500, 6, -1]),
        raw(7, [3, 16]),
        raw(7, [-1, 16]),
        raw(7, [1, 0]),
        *(raw(8, [-1 if i == word else 1 for i in range(5)]) for word in range(5)),
        raw(8, [1, 1, 1, 1, 16385]),
        links_down(0),
        links_down(),
    ):
        case(parameter, parameter[0], 19)
    log.title("what only the commit finds")
    for parameter, reason in at_commit:
        assert parameter[0] in by_number
        case(parameter, 127, reason)
    return log


def wire():
    log = Log("wire.log", "What cells and the gateway's side say to each other over wires, and what is no word of that.")
    log.title("every kind, in the order of a cell's life")
    there, here = (12, 0), (12, 1)
    log.say(
        hello(there, 0, 2, ["unnumbered"]),
        hello(here, 0, 4, ["hears"], (3, 0)),
        bare_wire(there, "join"),
        grant(here, 3, 0),
        state_of(there, 255),
        hello(there, 7, 2, ["hears", "up"], (3, 1)),
        nack(here, 9),
        repair(there, 3),
        walk(here, "node_id", 5, 1, 254),
        walk(there, "result", 5, 200, 199),
        bare_wire(there, "leave"),
        bare_wire(there, "probe"),
        bare_wire(here, "leave_ack"),
        bare_wire(here, "refuse"),
    )
    log.title("the largest and the smallest of everything")
    log.say(
        hello((0, 0), 0, 0, version=0),
        hello((65535, 1), 254, 7, list(HELLO), (255, 255), version=255),
        grant((65535, 0), 255, 255),
        state_of((0, 1), 0),
        nack((1, 0), 128),
        repair((255, 1), 255),
        walk((256, 0), "node_id", 255, 255, 0),
        walk((257, 1), "result", 0, 1, 1),
    )
    log.title("a label that nobody says is there is not looked at; the highest bit of a hello's flags neither")

    def odd(meaning_of, *rest):
        log.add(meaning_of.meaning, Wire("", meaning_of.link, *rest).classic())

    odd(hello(there, 7, 2), 1, 1, 7, 2, 9, 9)
    odd(hello(there, 7, 2), 1, 1, 7, 2 | 0x80, 0, 0)
    odd(bare_wire(there, "join"), 2, 1, 2, 3, 4, 5)
    odd(grant(here, 3, 0), 3, 3, 0, 9, 9, 9)

    log.title("kinds that do not exist")
    for kind in (0, 13, 255):
        log.add("bad wire", Wire("", there, kind, 1, 2, 3).classic())
    log.title("damaged, on another link, of another length")
    good = hello(there, 7, 2, ["hears", "up"], (3, 1))
    for bit in (0, 7, 8, 47, 48, 63):
        flipped = bytearray(good.bytes())
        flipped[bit // 8] ^= 1 << bit % 8
        log.add("bad wire", f"{good.id():08X}#{flipped.hex().upper()}")
    data = good.bytes().hex().upper()
    log.add("bad wire", f"{good.id() ^ 1:08X}#{data}")
    log.add("bad wire", f"{good.id() + 2:08X}#{data}")
    log.add("bad wire", f"{good.id():08X}#{data[:14]}")
    log.add("bad wire", f"{good.id():08X}#")
    log.title("no wire: another identifier, a remote frame")
    log.add("bad foreign", f"{good.id() ^ 0x10000000:08X}#{data}")
    log.add("bad foreign", f"{good.id() | 0x20000:08X}#{data}")
    log.add("bad foreign", f"{good.id():08X}#R8")
    return log


def document():
    log = Log("document.log", "The frames that the documents in docs/reference spell out; they must hold each of them.")
    value_of = configuration_hash(PARAMETERS)
    log.title("the worked example of the CRC, as one frame")
    log.put(torque(12, 7, [4096, -2048, 1, 0, 0, 0]))
    log.title("halt, sync, joints")
    log.put(command("halt"), command("sync"), command("resume"), joints(7, [angle(q) for q in ANGLES]))
    log.title("a configuration")
    for tag, parameter in enumerate(PARAMETERS, 1):
        log.put(write(CELL, tag, parameter))
    log.put(write(CELL, 11, commit(value_of)))
    log.title("pressing a cell from a shell")
    log.put(write(CELL, 12, mode(1)), stimulus(CELL, None, PRESSED), stimulus(CELL, None, skin([0, 0, 0])))
    log.put(torque(CELL, 7, answer([1024] * 3)[3]), torque(CELL, 8, [0] * 6))
    log.title("when a cell says what it feels")
    log.put(write(EVERYONE, 0, sensing("event")), write(CELL, 0, sensing("continuous", 16)))
    log.put(sensors(CELL, 7, skin([1024] * 3)), sensors(CELL, 8, skin([0, 0, 0])))
    return log


def main():
    stale = 0
    logs = (fd(), lenient(), bad(), classic(), session(), exchange(), refusals(), wire(), document(), arithmetic())
    for log in logs:
        path = HERE / log.name
        if "--check" in sys.argv[1:]:
            if not path.exists() or path.read_text() != log.text():
                print(f"{path} is not what make.py writes")
                stale = 1
        else:
            path.write_text(log.text())
    return stale


if __name__ == "__main__":
    sys.exit(main())
