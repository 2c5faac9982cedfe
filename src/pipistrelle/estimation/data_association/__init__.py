"""Who is who: the package's own associations. `sequential` is the stage, file by file below it."""
