"""A run's recording as third-party libraries read it: each message is one line of its fields' values.

    recording.py mcap MCAP        mcap and mcap-ros2-support
    recording.py bag MCAP         rosbags
    recording.py tf MCAP          compares the robot's frames, as /tf and /tf_static have them, with forward kinematics: of
                                  /robot_description by Pinocchio, and of the rows in skin.toml; exit code 1 where they differ

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


class Frames:
    """A tree of frames."""

    def __init__(self):
        self.parents = {}

    def take(self, message):
        import pinocchio as pin

        for it in message.transforms:
            parent, child = it.header.frame_id, it.child_frame_id
            assert self.parents.get(child, (parent,))[0] == parent, f"{child} has two parents"
            t, r = it.transform.translation, it.transform.rotation
            pose = pin.XYZQUATToSE3([t.x, t.y, t.z, r.x, r.y, r.z, r.w])
            self.parents[child] = parent, pose

    def pose(self, frame, root):
        import pinocchio as pin

        pose = pin.SE3.Identity()
        while frame != root:
            frame, above = self.parents[frame]
            pose = above * pose
        return pose


def rows_of(skin, chain):
    """A chain's rows, each with the index of its joint, and the base of the chain."""
    import pinocchio as pin

    base = chain.get("base", {})
    pose = pin.XYZQUATToSE3([*base.get("position", [0.0] * 3), *base.get("orientation", [0.0, 0.0, 0.0, 1.0])])
    names = [joint["name"] for joint in skin["robot"].get("joint", [])]
    rows = [(row, names.index(row["joint"]) if "joint" in row else None) for row in chain["rows"]]
    return pose, rows


def row_frames(skin, chain, q):
    """The frames behind each row by Rz(theta + theta_offset) Tz(d) Tx(a) Rx(alpha)."""
    import numpy as np
    import pinocchio as pin

    pose, rows = rows_of(skin, chain)
    frames = [pose]
    for row, joint in rows:
        theta, d = row.get("theta_offset", 0.0), row.get("d", 0.0)
        if joint is not None:
            slides = skin["robot"]["joint"][joint].get("kind") == "prismatic"
            theta, d = (theta, d + q[joint]) if slides else (theta + q[joint], d)
        turn = pin.SE3(pin.utils.rotate("z", theta), np.array([0.0, 0.0, d]))
        twist = pin.SE3(pin.utils.rotate("x", row.get("alpha", 0.0)), np.array([row.get("a", 0.0), 0.0, 0.0]))
        frames.append(frames[-1] * turn * twist)
    return frames


def skin_of(text):
    """A skin with its joints and chains spelled out."""
    import tomllib

    skin = tomllib.loads(text)
    robot = skin["robot"]
    if "joints" in robot:
        robot["joint"] = [{"name": f"joint{number + 1}"} for number in range(len(robot["joints"]))]
        rows = [{**row, "joint": f"joint{number + 1}"} for number, row in enumerate(robot["joints"])]
        robot["chain"] = [{"name": "chain", "rows": rows}]
    return skin


def cell_poses(skin, q):
    """The position and the normal of each cell, by name."""
    import numpy as np
    import pinocchio as pin

    chains = {chain["name"]: chain for chain in skin["robot"]["chain"]}
    buses = {bus["name"]: bus for bus in skin.get("bus", [{"name": "vcan0"}])}
    frames = {name: row_frames(skin, chain, q) for name, chain in chains.items()}
    for cell in skin["cell"]:
        bus = cell.get("bus", next(iter(buses)))
        name = buses[bus].get("chain", next(iter(chains)))
        moving = [at for at, row in enumerate(chains[name]["rows"]) if "joint" in row]
        row = cell.get("row", moving[cell["joint"] - 1] + 1)
        normal = cell.get("normal")
        if normal is None:
            turn = pin.XYZQUATToSE3([0.0, 0.0, 0.0, *cell["orientation"]])
            normal = turn.rotation @ [0.0, 0.0, 1.0]
        frame = frames[name][row]
        place = frame.act(np.array(cell["position"]))
        yield f"{bus}/{cell['node']}", place, frame.rotation @ normal / np.linalg.norm(normal)


def compare(path):
    import numpy as np
    import pinocchio as pin
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    still, moving, states, named, urdf = Frames(), [], {}, set(), None
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        skin = skin_of(next(it.data for it in reader.iter_attachments() if it.name == "skin.toml").decode())
        for _, channel, message, ros in reader.iter_decoded_messages():
            if channel.topic == "/robot_description":
                urdf = ros.data
            elif channel.topic == "/tf_static":
                still.take(ros)
            elif channel.topic == "/tf":
                moving.append((message.publish_time, ros))
            elif channel.topic.endswith("/joint_states"):
                states[message.publish_time] = ros
                assert len(ros.name) == len(ros.position) == len(ros.velocity) == len(ros.effort)
            elif channel.topic.endswith("/joint_commands"):
                assert len(ros.name) == len(ros.position) == len(ros.velocity) == len(ros.effort)
            elif channel.topic.startswith("/skin/"):
                named.add(ros.header.frame_id)
    model = pin.buildModelFromXML(urdf)
    data, worst = model.createData(), 0.0
    root = next(frame.name for frame in model.frames if frame.type == pin.FrameType.BODY)
    for time, message in moving:
        still.take(message)
        state = states[time]
        positions = dict(zip(state.name, state.position))
        q = pin.neutral(model)
        for joint, name in list(zip(model.joints, model.names))[1:]:
            at = positions.get(name, 0.0)
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(at), np.sin(at)] if joint.nq == 2 else [at]
        pin.framesForwardKinematics(model, data, q)
        for index, frame in enumerate(model.frames):
            if frame.type == pin.FrameType.BODY:
                apart = data.oMf[index].actInv(still.pose(frame.name, root))
                worst = max(worst, np.abs(apart.homogeneous - np.eye(4)).max())
        for name, place, normal in cell_poses(skin, state.position):
            pose = still.pose(name, root)
            worst = max(worst, np.abs(pose.translation - place).max(), np.abs(pose.rotation[:, 2] - normal).max())
    unknown = named - {root, *still.parents}
    print(f"{len(moving)} poses of {len(still.parents)} frames on {root}, at most {worst:.1e} apart; "
          f"messages name {len(named)} frames")
    assert moving and not unknown and worst < 1e-6, (len(moving), unknown, worst)


if __name__ == "__main__":
    {"mcap": by_mcap, "bag": by_rosbags, "tf": compare}[sys.argv[1]](sys.argv[2])
