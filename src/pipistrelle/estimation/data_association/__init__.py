"""Data association: `sequential` matches scan by scan; the other files are its steps."""
