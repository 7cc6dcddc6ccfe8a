#!/usr/bin/env python3
"""Plots the torques of a robot's joints from a recording; without one, runs the demo for 6 s and plots that.

pip install matplotlib
python plot_torques.py [RECORDING.mcap] [-o torques.png]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import skinbus


def record_demo(file: Path) -> None:
    """Runs the demo, 253 cells on an arm, and records it."""
    command = [str(skinbus.program_path("skinbus")), "demo", "--duration", "6", "--quiet", "--record", str(file)]
    subprocess.run([*command, "--candump", str(file.with_suffix(".log"))], check=True, stdout=subprocess.DEVNULL)


def plot(recording: Path, picture: Path) -> None:
    """Plots the sum of the cells' torques, and the torque computed centrally, of each joint that the skin turns."""
    try:
        from matplotlib import pyplot
    except ImportError:
        sys.exit("plot_torques.py: matplotlib is not installed: pip install matplotlib")
    with skinbus.read(recording, index=False) as run:
        epochs = run.epochs()
        seconds = (epochs.at_ns - run.began_ns) * 1e-9
        for joint, name in enumerate(epochs.names):
            if epochs.distributed[:, joint].any():
                (line,) = pyplot.plot(seconds, epochs.distributed[:, joint], label=name)
                pyplot.plot(seconds, epochs.central[:, joint], "--", color=line.get_color(), linewidth=0.7)
        pyplot.title(f"{run.robot}: torques of {len(run.cells)} cells (dashed: computed centrally)")
    pyplot.xlabel("time (s)")
    pyplot.ylabel("torque (Nm)")
    pyplot.legend()
    pyplot.savefig(picture, dpi=150)


def main() -> None:
    """Reads the arguments and plots."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("recording", nargs="?", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("torques.png"))
    arguments = parser.parse_args()
    if arguments.recording is not None:
        plot(arguments.recording, arguments.output)
    else:
        with tempfile.TemporaryDirectory() as folder:
            record_demo(Path(folder) / "demo.mcap")
            plot(Path(folder) / "demo.mcap", arguments.output)
    print(f"wrote {arguments.output}")


if __name__ == "__main__":
    main()
