"""The player of a mission: `playback` and its page, style and scripts."""
