"""A DBC as cantools reads it, against frames whose meaning another program wrote beside them.

    dbc.py DBC GOLDEN        decodes each frame of the log, compares it with the comment above it, encodes it again

Prints how many frames of each kind were compared. The DBC is of a bus with all 254 cells.
"""

import math
import sys

import cantools

AXES = ("x", "y", "z")
HEARD = {"joints_late": "joints_skipped"}
PARAMETERS = {
    "joint": "mount_joint",
    "joints": "mount_joints",
    "row": "mount_row",
    "rows": "mount_rows",
    "torque_format": "mount_torque_format",
    "alpha_c": "alpha_c",
    "alpha_p": "alpha_p",
    "contact_threshold": "contact_threshold",
    "proximity_threshold": "proximity_threshold",
    "force_threshold": "force_threshold",
    "period_us": "period",
    "on": "mode",
}


def numbers(text):
    return [float(number) for number in text.split(",")]


def numbered(name, text):
    return {f"{name}_{index}": value for index, value in enumerate(numbers(text), 1)}


def on_axes(name, text):
    return {f"{name}_{axis}": value for axis, value in zip(AXES, numbers(text))}


def sensors_of(fields):
    if "acceleration" in fields:
        return {"page": 1} | on_axes("acceleration", fields["acceleration"])
    if "zero" in fields:
        said = {"page": 3} | {f"baseline_{key}": float(fields[key]) for key in ("zero", "n_per_c", "found_at", "refused")}
        flags = fields["flags"].split("+")
        return said | {f"baseline_{flag}": int(flag in flags) for flag in ("tared", "touched", "limited")}
    return (
        {"page": 0, "proximity": float(fields["proximity"])}
        | numbered("contact", fields["contact"])
        | numbered("temperature", fields["temperature"])
    )


def state(fields):
    names = "configured active halted flash-damaged duplicate test-mode saturated claiming".split()
    there = fields["state"].split("+")
    bits = {f"state_{name.replace('-', '_')}": int(name in there) for name in names}
    return bits | {"state_joint": int(fields["joint"]), "state_version": int(fields["version"])}


def bits(text):
    return {int(bit) for bit in text.split("+") if bit != "none"}


def tree(fields):
    said = {key: int(fields[key]) for key in ("up", "depth", "round")}
    said |= {f"sums_{key}": int(fields[key]) for key in ("sent", "taken", "dropped")}
    said["parent"] = 255 if fields["parent"] == "none" else int(fields["parent"])
    said |= {f"child_at_{port}": int(port in bits(fields["children"])) for port in range(4)}
    return said | {f"port_{port}_works": int(port in bits(fields["works"])) for port in range(5)}


def ports(fields):
    said = {"parent_changes": int(fields["changes"])}
    for port in range(4):
        number, there, flags = fields[f"port{port}"].split("/")
        names = {"hears": "hears", "works": "both_ways", "other-version": "other_version"}
        said |= {f"port_{port}_leads_to": int(number), f"port_{port}_leads_to_port": int(there)}
        said |= {f"port_{port}_{name}": int(flag in flags.split("+")) for flag, name in names.items()}
    return said


def switch(fields):
    """The written values of parameters 6 to 9, 11 and 12."""
    if "reply" in fields:
        said = {"reply": int(fields["reply"] == "sum")}
        keys = {"slot_us": "reply_slot", "deepest": "reply_deepest", "carry": "reply_carry"}
    elif "sensing" in fields:
        said = {"sensing": ["off", "continuous", "event"].index(fields["sensing"])}
        keys = {"period_ms": "sensing_period"}
    elif "deaf" in fields:
        return {f"link_down_port_{port}": int(port in bits(fields["deaf"])) for port in range(5)}
    elif "baseline" in fields:
        said = {"baseline": ["off", "hold", "follow"].index(fields["baseline"])}
        keys = {key: f"baseline_{key}" for key in ("threshold", "hysteresis", "rate_un_per_s", "limit", "n_per_c")}
    elif "tare" in fields:
        return {"tare": int(fields["tare"])}
    elif "hysteresis" in fields:
        said = {}
        keys = {key: f"events_{key}" for key in ("contact", "proximity", "temperature", "acceleration", "hysteresis")}
    else:
        return {}
    return said | {name: float(fields[key]) for key, name in keys.items() if key in fields}


def parameter(fields):
    number = int(fields["parameter"])
    if 6 <= number <= 9 or number in (11, 12):
        return {"parameter": number, "tag": int(fields["tag"])} | switch(fields)
    said = {"parameter": number, "tag": int(fields["tag"])}
    for key, text in fields.items():
        if key == "position":
            said |= on_axes("pose", text)
        elif key == "normal":
            said |= on_axes("normal", text)
        elif key == "hash":
            said["commit_hash"] = int(text, 16)
        elif key in ("a", "d"):
            said[f"row{number - 15}_{key}"] = float(text)
        elif key in ("alpha", "theta_offset"):
            said[f"row{number - 15}_{key}"] = float(text) * math.pi / 2
        elif key == "kind":
            said[f"row{number - 15}_kind"] = ["revolute", "prismatic", "fixed"].index(text)
        elif key in PARAMETERS:
            said[PARAMETERS[key]] = float(text)
    return said


def meaning(kind, fields):
    """The message's name and the expected values of its signals."""
    who = fields.get("from", fields.get("to"))
    epoch = {"epoch": int(fields["epoch"])} if "epoch" in fields else {}
    match kind:
        case "halt" | "sync" | "resume" | "report":
            return kind, {}
        case "joints":
            angles = numbered("position", fields["positions"])
            angles = {name: value * math.pi / 2 for name, value in angles.items()}
            return kind, epoch | angles | {"count": int(fields["in_use"])}
        case "sum":
            return f"sum_{who}", epoch | numbered("sum", fields["torque"]) | {"count": int(fields["count"])}
        case "torque":
            return f"torque_{who}", epoch | numbered("torque", fields["torque"]) | {"count": 1}
        case "sensors":
            return f"sensors_{who}", epoch | sensors_of(fields)
        case "heartbeat":
            said = {"page": 0, "serial": int(fields["serial"]), "configuration": int(fields["configuration"], 16)}
            said |= {"sent": int(fields["sent"]), "rejected": int(fields["rejected"])}
            return f"network_{who}", epoch | said | state(fields)
        case "heard" | "refused":
            counters = {key: int(text) for key, text in fields.items() if key not in ("from", "epoch")}
            counters = {f"{kind}_{HEARD.get(key, key)}": count for key, count in counters.items()}
            return f"network_{who}", epoch | counters | {"page": 1 if kind == "heard" else 2}
        case "tree":
            return f"network_{who}", epoch | tree(fields) | {"page": 3}
        case "ports":
            return f"network_{who}", epoch | ports(fields) | {"page": 4}
        case "read" | "write":
            return f"configure_{who}", parameter(fields) | {"write": int(kind == "write")}
        case "value" if "words" in fields:
            # Identity: two words of serial number, version, hash, state.
            words = [int(word) & 0xFFFF for word in fields["words"].split(",")]
            said = {"serial": words[0] | words[1] << 16, "version": words[2], "configuration": words[3]}
            said |= {"state_joint": words[4] >> 8 & 15, "state_version": words[4] >> 12}
            return f"configured_{who}", parameter(fields) | said | {"written": 0}
        case "value" | "written":
            return f"configured_{who}", parameter(fields) | {"written": int(kind == "written")}
        case "refusal":
            said = {"tag": int(fields["tag"]), "parameter": 126, "written": 0}
            said |= {"refused_parameter": int(fields["parameter"]), "refused_reason": int(fields["reason"])}
            return f"configured_{who}", said
        case "stimulus":
            when = {"from_next": 1} if fields["from"] == "next" else {"from_next": 0, "epoch": int(fields["from"])}
            return f"stimulus_{fields['to']}", when | sensors_of(fields)
    raise SystemExit(f"unknown kind {kind}")


def frames(path):
    comment = ""
    for line in open(path, encoding="utf-8"):
        if line.startswith("# "):
            comment = line[2:].strip()
        elif line.startswith("("):
            identifier, _, data = line.split()[2].partition("##")
            yield comment, int(identifier, 16), bytes.fromhex(data[1:])


def main(dbc, golden):
    database = cantools.database.load_file(dbc, strict=True)
    assert {message.length for message in database.messages} == {16}
    assert all(message.is_fd and not message.is_extended_frame for message in database.messages)
    compared = {}
    for comment, identifier, data in frames(golden):
        kind, *words = comment.split()
        fields = dict(word.split("=", 1) for word in words)
        message = database.get_message_by_frame_id(identifier)
        if len(data) != 16:
            # A chain with more joints than this bus has.
            compared["longer"] = compared.get("longer", 0) + 1
            continue
        if 21 < int(fields.get("parameter", 0)) < 126:
            # A row that no cell of this bus has, or no parameter at all: the DBC has no words for it.
            try:
                message.decode(data)
            except cantools.database.errors.DecodeError:
                compared["unknown"] = compared.get("unknown", 0) + 1
                continue
            raise SystemExit(f"{comment}: the DBC decoded a frame that it must not know")
        said = message.decode(data, decode_choices=False)
        name, expected = meaning(kind, fields)
        assert message.name == name, f"{comment}: {message.name}"
        expected["crc"] = int.from_bytes(data[14:], "little")
        for signal, value in expected.items():
            assert abs(said[signal] - value) < 1e-9, f"{comment}: {signal} is {said[signal]}, not {value}"
        assert message.encode(said, strict=False) == data, f"{comment}: encoded differently"
        compared[kind] = compared.get(kind, 0) + 1
    saturated = database.get_message_by_name("torque_254").get_signal_by_name("torque_1").choices
    assert {int(value): str(text) for value, text in saturated.items()} == {32767: "saturated", -32768: "saturated"}
    joints = database.get_message_by_name("joints")
    assert (joints.cycle_time, joints.senders, len(joints.receivers)) == (16, ["gateway"], 254)
    print(" ".join(f"{kind}={count}" for kind, count in sorted(compared.items())))


if __name__ == "__main__":
    main(*sys.argv[1:])
