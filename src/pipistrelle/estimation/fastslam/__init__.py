"""FastSLAM 2.0: particles, each a sampled path with its own map.

`filter` is the method and `poses` its resampling. The kernels: `particles` goes over all of them, a
`block` of 32 at a time, whose rays `block_rays` weighs and prunes.
"""
