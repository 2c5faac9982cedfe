"""Data association, as the package does it: `sequential` is the stage, the others are its steps."""
