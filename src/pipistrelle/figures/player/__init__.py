"""A mission frame by frame: `playback` lays out its numbers, `page` and `rerun_file` show them."""
