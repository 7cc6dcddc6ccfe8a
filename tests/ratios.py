"""Prints, as a table, what the benchmarks of one run say of each other: python3 tests/ratios.py [TARGET]

Wall times are medians that criterion wrote below TARGET/criterion, instructions those that valgrind counted below
TARGET/gungraun. A benchmark that has not run leaves its line out.
"""

import json
import pathlib
import sys

# Name, benchmark, reference, and the required ratio, if there is one.
WALL = [
    ("candump reader: lines/s, of the crate socketcan's", "candump/socketcan", "candump/this reader", ">= 3"),
    ("wrench kernel: time, of nalgebra's in f64", "jacobian/wrench", "jacobian/nalgebra f64", ""),
    ("wrench kernel: time, of nalgebra's in f32", "jacobian/wrench", "jacobian/nalgebra f32", ""),
    ("wrench kernel: time, of the projection kernel's", "jacobian/wrench", "jacobian/projection", ""),
    ("receiving 253 frames: time, of a C loop with recv", "epoch of 253 frames/frames", "epoch of 253 frames/recv in C", ""),
    ("receiving 253 frames and all accounts: the same", "epoch of 253 frames/table", "epoch of 253 frames/recv in C", ""),
    ("tick with 253 active cells: distributed, of central", "tick/distributed/253", "tick/central, all active/253", ""),
    ("tick with 10 000 active cells: the same", "tick/distributed/10000", "tick/central, all active/10000", ""),
]
COUNTED = [
    ("wrench kernel: instructions, of the projection kernel's", "wrench.k6", "projection.k6", "<= 0.5"),
    ("wrench kernel: instructions, of nalgebra's in f64", "wrench.k6", "nalgebra_f64.k6", ""),
    ("wrench kernel: instructions, of nalgebra's in f32", "wrench.k6", "nalgebra_f32.k6", ""),
    ("sine of seventh order: instructions, of the fifth's", "seventh_order", "fifth_order", ""),
    ("classic pair, read: instructions, of one FD frame", "paired.classic", "decoded.fd", ""),
]


def wall_times(target):
    """Medians in ns by benchmark."""
    times = {}
    for about in target.glob("criterion/**/new/benchmark.json"):
        estimates = json.loads((about.parent / "estimates.json").read_text())
        times[json.loads(about.read_text())["full_id"]] = estimates["median"]["point_estimate"]
    return times


def instructions(target):
    """Instructions by benchmark."""
    counts = {}
    for profile in target.glob("gungraun/**/callgrind.*.out"):
        for line in profile.read_text().splitlines():
            if line.startswith("totals:"):
                counts[profile.name.removeprefix("callgrind.").removesuffix(".out")] = int(line.split()[1])
    return counts


def main():
    target = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "target")
    if not target.is_dir():
        sys.exit(f"ratios: {target} is not a folder; name cargo's target folder")
    lines = []
    for rows, values, unit in ((COUNTED, instructions(target), ""), (WALL, wall_times(target), " ns")):
        for what, above, below, bar in rows:
            if above in values and below in values:
                ratio = values[above] / values[below]
                lines.append((what, f"{ratio:.3g}", bar, f"{values[above]:.0f} / {values[below]:.0f}{unit}"))
    if not lines:
        sys.exit(f"ratios: there are no benchmark results below {target}; run `cargo bench --workspace`")
    print(f"\n{'ratio':<58} {'':>8}  {'bar':<7} of")
    for what, ratio, bar, of in lines:
        print(f"{what:<58} {ratio:>8}  {bar:<7} {of}")


main()
