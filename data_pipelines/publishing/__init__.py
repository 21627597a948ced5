"""How anything that takes long to make gets to its place: whole, once, and in any number of attempts.

Owns the one scheme that tokens, conversions, the suite and the simulators share; knows nothing of what is made.

* `claims`: who makes a thing. A lock file beside it, which ends with its process; others wait, or do
  something else. Whoever claims a thing removes what dead processes left of it, and nobody else's.
* `files`: written aside, forced to the disk, renamed into place. A reader sees all of a thing or nothing.
* `marks`: a fingerprint of everything the bytes depend on, stored inside; what is there and has it is kept.
* `journal`: what is finished of a thing that one process makes step by step, so that the next goes on there.

What a claim promises on which file system is said in `hma_jax.runtime.locks`. Where it fails, on a shared disk
without locks whose lease ran out, two processes make the same thing: both write equal bytes to directories of
their own and rename them, so that nothing but time is lost.
"""
