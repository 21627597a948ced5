"""What knows platforms. The model's text is mathematics; which program computes it is decided here.

`attention`     attention within frames, over time and over a cache, behind one call each
`plain`         the formulas, for every platform: what the other backends must equal
`cpu`, `cudnn`, `splash`   the same for CPUs, for NVIDIA GPUs, for TPUs
`dense`         products with a weight, and one weight per robot
`pointwise`     layer norm without its parameters, GELU, broadcast over tokens
`remat`         what a block keeps for its backward pass

Gradients that are written out, and thresholds between backends, are in this folder and nowhere else, but for how the
gradient of a parameter goes back to where that is stored (`runtime.sharding`). A new backend is one file with the
functions of `attention.Backend` and one line in its table.
"""
