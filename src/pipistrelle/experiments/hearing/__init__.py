"""Simulated worlds and their scans: `scenario` draws a world, `listening` simulates its frames.

`oracle` labels detections by the true arrivals. `world_folder` reads and writes worlds as text
files, and `sound_recorder` writes the microphones' samples.
"""
