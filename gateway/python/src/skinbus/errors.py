"""Exceptions of this package."""

from __future__ import annotations


class SkinbusError(Exception):
    """Base class of this package's exceptions."""


class ProgramMissing(SkinbusError, FileNotFoundError):
    """A program of the bench is not installed. The text says what to do."""
