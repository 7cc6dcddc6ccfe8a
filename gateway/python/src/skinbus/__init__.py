"""Benches of robot skin on CAN, from Python."""

from skinbus._programs import program_path
from skinbus.recording import read

__all__ = ["program_path", "read"]
