"""Torques that cells of a moving robot sent, against Pinocchio.

    chains.py URDF CELLS JOINTS DUMP     CELLS: link,px,py,pz,nx,ny,nz; cell i has node id i
                                         JOINTS: the chain's joints, base to tip, with commas
                                         DUMP: `skinbus dump --json --kind joints,stimulus,torque` of the recording

Each torque is compared with that of the force in the cell's last stimulus, at the positions that were broadcast in its
epoch. Torques within 0.1 s of a stimulus are left out: the force may be the one before. Prints the number of torques, the
mean and the maximum of the difference over the joints that move the cell, in Nm or N, the range over which the joint that
moved furthest moved, and the number of torques with a saturated word, which are left out.
"""

import csv
import json
import sys

import numpy
import pinocchio

CLOSE_NS = 100_000_000


class Cell:
    """A cell at a point of a link, as a frame of the model."""

    def __init__(self, model, row, node):
        link, *numbers = row
        point, normal = numpy.array(numbers[:3], float), numpy.array(numbers[3:], float)
        self.normal = normal / numpy.linalg.norm(normal)
        parent = model.frames[model.getFrameId(link)]
        place = parent.placement * pinocchio.SE3(numpy.eye(3), point)
        frame = pinocchio.Frame(f"cell {node}", parent.parentJoint, place, pinocchio.FrameType.OP_FRAME)
        self.frame = model.addFrame(frame)
        self.normal = parent.placement.rotation @ self.normal
        self.rotation = place.rotation.T
        self.joint = parent.parentJoint


def main(urdf, cells, joints, dump):
    model = pinocchio.buildModelFromUrdf(urdf)
    names = joints.split(",")
    with open(cells, encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    cells = {node: Cell(model, row, node) for node, row in enumerate(rows, 1)}
    data = model.createData()
    index = [model.joints[model.getJointId(name)] for name in names]

    def configuration(positions):
        q = pinocchio.neutral(model)
        for joint, position in zip(index, positions):
            if joint.nq == 2:  # continuous: cosine and sine
                q[joint.idx_q : joint.idx_q + 2] = numpy.cos(position), numpy.sin(position)
            else:
                q[joint.idx_q] = position
        return q

    def torque(cell, force, q):
        jacobian = pinocchio.computeFrameJacobian(model, data, q, cell.frame, pinocchio.ReferenceFrame.LOCAL)[:3]
        tau = jacobian.T @ (cell.rotation @ (-force * cell.normal))
        return numpy.array([tau[joint.idx_v] for joint in index])

    events, last = [], {node: [] for node in cells}
    with open(dump, encoding="utf-8") as file:
        for line in file:
            event = json.loads(line)
            if event["verdict"] != "ok":
                continue
            events.append(event)
            if event["kind"] == "stimulus" and event["values"]["page"] == "skin":
                last[event["node"]].append((event["time_ns"], event["values"]["force_n"]))

    heard, reached, differences, saturated = {}, [], [], 0
    for event in events:
        time = event["time_ns"]
        if event["kind"] == "joints":
            positions = event["values"]["position_rad"]
            heard[event["epoch"]] = (time, configuration(positions))
            reached.append(positions)
        elif event["kind"] == "torque":
            stimuli = last[event["node"]]
            before = [force for at, force in stimuli if at + CLOSE_NS < time]
            near = any(abs(at - time) <= CLOSE_NS for at, _ in stimuli)
            if near or not before or event["epoch"] not in heard:
                continue
            if event["saturated"]:
                saturated += 1
                continue
            cell = cells[event["node"]]
            _, q = heard[event["epoch"]]
            expected = torque(cell, before[-1], q)
            sent = numpy.array(event["values"]["torque_nm"])[: len(names)]
            moving = [joint.id <= cell.joint for joint in index]
            differences.append(numpy.abs(sent - expected)[moving])
            assert not numpy.any(sent[numpy.logical_not(moving)]), event
    reached = numpy.array(reached)
    moved = numpy.max(reached.max(axis=0) - reached.min(axis=0))
    every = numpy.concatenate(differences)
    print(len(differences), every.mean(), every.max(), moved, saturated)


main(*sys.argv[1:])
