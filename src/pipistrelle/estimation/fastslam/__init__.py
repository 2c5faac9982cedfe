"""FastSLAM 2.0: particles, each with a sampled path and a map.

`filter` is the estimator. The kernels: `particles` iterates over blocks of 32 particles, `block`
and `block_rays` update poses and landmarks, `poses` predicts, summarises and resamples.
"""
