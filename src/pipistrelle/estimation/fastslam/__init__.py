"""FastSLAM 2.0: particles, each a sampled path with its own map.

`filter` is the method, `resampling` its last step. The kernels: `particles` walks over all of them,
a `block` of 32 at a time, whose rays `block_rays` weighs and prunes. Where excess paths are heard,
landmarks are Gaussians conditional on their caller (`conditional_landmarks`), and
`block_conditional` corrects both together.
"""
