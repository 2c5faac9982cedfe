"""Smoothing: `filter` re-thinks the whole path, `graph` holds it, `legs` lead from pose to pose."""
