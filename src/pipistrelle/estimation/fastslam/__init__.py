"""FastSLAM 2.0: particles, each with a sampled path and a map.

`filter` is the estimator. The kernels: `particles` predicts, updates and resamples all particles,
`block` updates poses and landmarks of a block of 32.
"""
