"""Everything that depends on the platform. The model's code states formulas; this package decides
how they are computed.

`attention`     attention within frames, over time and over a cache, behind one call each
`plain`         the formulas, for every platform: the reference of the other backends
`cpu`, `cudnn`, `splash`   the same for CPUs, NVIDIA GPUs and TPUs
`dense`         products with a weight, and one weight per robot
`pointwise`     layer norm without its parameters, GELU, broadcast over tokens
`remat`         what a block saves for its backward pass
`random`        random numbers that do not depend on JAX's settings

Hand-written gradients and thresholds between backends are only in this folder, except for the gradient of a parameter's
change of layout (`runtime.sharding`). A new backend is one file with the functions of `attention.Backend` and one line
in its table.
"""
