"""Sonar SLAM with one's own calls, someone else's, or both: from waveform to verdict."""

__version__ = "0.1.0"
